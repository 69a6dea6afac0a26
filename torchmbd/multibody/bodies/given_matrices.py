"""Given mass and stiffness matrices as functions of the design: values on one pattern of all degrees of freedom 6 * node + i.

    M, K                                   numbers                                no design variables
    M, K, {name: (value, dM, dK)}          M + (b - value) dM, K + (b - value) dK       "rod.model.<name>"
    a torch module that returns (M, K)     dense [N, N], float64                        "rod.model.<its parameters>"
    a function of parameters, likewise     f(**parameters)                              "rod.model.<name>"

Numbers are arrays, tensors, SciPy sparse matrices, or a LabeledMatrix, as readers of files make. Rows: three displacements, or
these and three rotations, of each node in turn; or any degrees of freedom, each row named by (node, component).
Checked in tests/multibody/bodies/test_from_matrices.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.mesh import Mesh, NodeCloud
from torchmbd.math.checked_numbers import reals
from torchmbd.math.sparse import Pattern, SparseMatrix
from torchmbd.math.variable import ParameterVector
from torchmbd.multibody.bodies.matrix_modules import matrix_source

SYMMETRY = 1e-9  # largest unsymmetry, as a share of the largest entry
COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")


class LabeledMatrix(NamedTuple):
    """A square matrix; `rows`: (label of the node, direction 1 to 6) of each row, None: in the order of the nodes."""

    matrix: scipy.sparse.csr_array
    rows: list[tuple[int, int]] | None = None


class GivenMatrices:
    """M and K of a body; `now()` gives them for the present design, with lanes.

    mesh       the nodes
    freedoms   number 6 * node + component of each row [N]
    pattern    of M and K over all degrees of freedom
    module     the module whose parameters are design variables; None: there are none
    """

    def __init__(
        self,
        name: str,
        M: Any,
        K: Any,
        nodes: Any,
        freedoms: Any = None,
        derivatives: Mapping[str, tuple[Any, Any, Any]] | None = None,
        parameters: Mapping[str, float | Tensor] | None = None,
        node_sets: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        self.name = name
        source = matrix_source(name, M, K, derivatives, parameters)
        first = (M, K) if source is None else source.start()
        read = _aligned([_labeled((name, key), x) for key, x in zip("MK", first, strict=True)])
        labels, positions = _positions(name, nodes, read)
        self.freedoms = _freedoms(name, len(positions), freedoms, read, labels)
        further = [_labeled((name, "derivatives"), x) for x in ([] if source is None else source.further())]
        matrices = [x.matrix for x in (*read, *further)]
        if any(x.shape != (len(self.freedoms),) * 2 for x in matrices):
            raise InputError(
                (name, "matrices"),
                allowed=f"must have {len(self.freedoms)} rows and columns, one for each degree of freedom of "
                f"{len(positions)} nodes",
                state=f"have the shapes {', '.join(str(x.shape) for x in matrices)}",
            )
        self.pattern, values = _common_pattern(self.freedoms, matrices, 6 * len(positions))
        self.mesh = mesh_of(name, nodes, positions, node_sets, self._lines(positions))
        self._values = [_symmetric(name, key, self.pattern, v) for key, v in zip(("M", "K"), values[:2], strict=True)]
        self.module: nn.Module | None = None
        self._variables: ParameterVector | None = None
        if source is not None:
            symmetric = iter(_symmetric(name, "a derivative", self.pattern, v) for v in values[2:])
            module = source.on_pattern(self.pattern, self._values, self.freedoms, symmetric)
            self.module, self._variables = source.registered, ParameterVector.of(module)

    def now(self) -> tuple[SparseMatrix, SparseMatrix]:
        """M and K in the present design; both have the same lanes."""
        M, K = self._values if self._variables is None else self._variables.evaluated()
        return SparseMatrix(self.pattern, M, symmetric=True), SparseMatrix(self.pattern, K, symmetric=True)

    def pairs(self) -> Int[Tensor, "p 2"]:
        """Pairs of different nodes that K or M couples, each in both orders."""
        i, j = self.pattern.rows // 6, self.pattern.cols // 6
        return torch.unique(torch.stack([i, j], 1)[i != j], dim=0)

    def _lines(self, x: Tensor) -> Tensor:
        """The shortest of these pairs, three for each node, as lines of pictures."""
        pairs = self.pairs()
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        length = (x[pairs[:, 0]] - x[pairs[:, 1]]).norm(dim=1)
        return pairs[torch.argsort(length)[: 3 * len(x)]]


def mesh_of(
    name: str, nodes: Any, positions: Tensor, node_sets: Mapping[str, Sequence[int]] | None, lines: Tensor | None = None
) -> Mesh:
    """`nodes` itself if it is a Mesh, else positions [n, 3] as one; InputError for node_sets beside a Mesh."""
    if not isinstance(nodes, Mesh):
        lines = torch.empty(0, 2, dtype=torch.long) if lines is None else lines
        return NodeCloud(positions, node_sets=node_sets or {}, lines=lines)
    if node_sets is not None:
        raise InputError(
            (name, "node_sets"),
            node_sets,
            "left to the mesh, or given with nodes [n, 3]",
            state="are given beside a Mesh",
        )
    return nodes


def _labeled(label: tuple[str, str], matrix: Any) -> LabeledMatrix:
    """A matrix with its rows out of an array or a sparse matrix."""
    if isinstance(matrix, LabeledMatrix):
        read = matrix
    elif isinstance(matrix, (str, Path)):
        raise InputError(label, str(matrix), "numbers, such as mbd.io.read_matrix reads from a file")
    elif scipy.sparse.issparse(matrix):
        read = LabeledMatrix(scipy.sparse.csr_array(matrix, dtype=np.float64))
    else:
        dense = reals(label, matrix)
        if dense.dim() != 2:
            raise InputError(label, dense, "a square matrix", state=f"has shape {tuple(dense.shape)}")
        read = LabeledMatrix(scipy.sparse.csr_array(dense.detach().numpy()))
    if not np.isfinite(read.matrix.data).all():
        raise InputError(label, allowed="must have finite entries", state="has entries that are not finite")
    return read


def _aligned(read: list[LabeledMatrix]) -> list[LabeledMatrix]:
    """Matrices whose files state their rows, over the rows of all of them: degrees of freedom without mass are in K only."""
    if any(x.rows is None for x in read):
        return read
    rows = sorted({pair for x in read for pair in x.rows or ()})
    index = {pair: k for k, pair in enumerate(rows)}
    aligned = []
    for x in read:
        number = np.array([index[pair] for pair in x.rows or ()])
        coo = x.matrix.tocoo()
        shape = (len(rows), len(rows))
        aligned.append(
            LabeledMatrix(scipy.sparse.csr_array((coo.data, (number[coo.row], number[coo.col])), shape=shape), rows)
        )
    return aligned


def _positions(name: str, nodes: Any, read: Sequence[LabeledMatrix]) -> tuple[list[int] | None, Float[Tensor, "n 3"]]:
    """Labels of the nodes, if rows of the matrices refer to them, and positions [n, 3]."""
    if isinstance(nodes, Mapping):
        try:
            labels = sorted(int(label) for label in nodes)
            positions = np.array([list(nodes[label]) for label in labels], dtype=float).reshape(len(labels), 3)
        except (TypeError, ValueError, KeyError):
            raise InputError(
                (name, "nodes"), nodes, "a mapping number -> three coordinates", state=f"are {nodes!r}"
            ) from None
        return labels, reals((name, "nodes"), positions)
    x = nodes.nodes.detach() if isinstance(nodes, Mesh) else reals((name, "nodes"), nodes)
    if x.dim() != 2 or x.shape[1] != 3 or not len(x):
        raise InputError(
            (name, "nodes"), x, "must have shape [n, 3], or label -> place", state=f"have shape {tuple(x.shape)}"
        )
    labels = sorted({label for matrix in read if matrix.rows is not None for label, _ in matrix.rows})
    if labels and len(labels) != len(x):
        raise InputError(
            (name, "matrices"),
            allowed=f"must refer to {len(x)}, the number of given nodes",
            state=f"refer to {len(labels)} nodes",
        )
    return labels or None, x


def _freedoms(
    name: str, n: int, freedoms: Any, read: Sequence[LabeledMatrix], labels: list[int] | None
) -> Int[Tensor, " rows"]:
    """Number 6 * node + component of each row."""
    rows = next((matrix.rows for matrix in read if matrix.rows is not None), None)
    size = int(read[0].matrix.shape[0])  # pyright: ignore[reportOptionalSubscript]
    if rows is not None and freedoms is None:
        index = {label: k for k, label in enumerate(labels or [])}
        missing = [label for label, _ in rows if label not in index]
        if missing:
            raise InputError(
                (name, "nodes"), allowed="must have all labels of the matrices", state=f"lack the label {missing[0]}"
            )
        return torch.tensor([6 * index[label] + component - 1 for label, component in rows], dtype=torch.long)
    if freedoms is None:
        if size not in (3 * n, 6 * n):
            raise InputError(
                (name, "matrices"),
                allowed=f"must have {3 * n} or {6 * n}, or `freedoms`",
                state=f"have {size} rows for {n} nodes",
            )
        freedoms = size // n
    if freedoms in (3, 6):
        return (6 * torch.arange(n)[:, None] + torch.arange(int(freedoms))).flatten()
    try:
        pairs = [(int(node), COMPONENTS.index(c) if isinstance(c, str) else int(c)) for node, c in freedoms]
    except (TypeError, ValueError):
        raise InputError((name, "freedoms"), freedoms, "3, 6, or (node, component) of each row") from None
    if len(set(pairs)) != len(pairs) or any(not (0 <= k < n and 0 <= c < 6) for k, c in pairs) or len(pairs) != size:
        raise InputError(
            (name, "freedoms"),
            len(pairs),
            f"{size} different degrees of freedom, of nodes 0 to {n - 1}",
            state=f"are {len(pairs)}",
        )
    return torch.tensor([6 * k + c for k, c in pairs], dtype=torch.long)


def _common_pattern(freedoms: Tensor, matrices: Sequence[Any], size: int) -> tuple[Pattern, list[Tensor]]:
    """The symmetric pattern of the entries of all matrices, and the values of each on it."""
    entries = [matrix.tocoo() for matrix in matrices]
    number = freedoms.numpy()
    i = np.concatenate([number[e.row] for e in entries])
    j = np.concatenate([number[e.col] for e in entries])
    pattern, position = Pattern.gather(np.concatenate([i, j]), np.concatenate([j, i]), size)
    positions = list(position[: len(i)].split([len(e.data) for e in entries]))
    values = [
        torch.zeros(pattern.nnz, dtype=torch.float64).index_add(0, index, torch.from_numpy(np.array(e.data, float)))
        for index, e in zip(positions, entries, strict=True)
    ]
    return pattern, values


def _symmetric(name: str, key: str, pattern: Pattern, values: Tensor) -> Tensor:
    """The values made exactly symmetric; InputError if they are not symmetric to SYMMETRY."""
    difference = (values - values[pattern.transposed]).abs()
    worst = int(difference.argmax()) if len(values) else 0
    if len(values) and float(difference[worst]) > SYMMETRY * float(values.abs().max()):
        i, j = int(pattern.rows[worst]), int(pattern.cols[worst])
        raise InputError(
            (name, key),
            allowed="symmetric to 1e-9",
            state=f"has {float(values[worst]):.9g} between {freedom(i)} and {freedom(j)}, "
            f"{float(values[pattern.transposed[worst]]):.9g} in the transposed entry",
        )
    return 0.5 * (values + values[pattern.transposed])


def freedom(k: int) -> str:
    """Name of the degree of freedom k = 6 * node + i in messages."""
    return f"node {k // 6} {COMPONENTS[k % 6]}"
