"""The reduction of a body to modes, checked with the first design.

Modes of equal frequencies are retained together: bending of a tube in two directions is such a pair, and one mode of a pair has
no derivative alone (fem/reduction/transport.py). So a design may retain a few more modes than requested (fem/reduction/cut.py).
Checked in tests/multibody/bodies/test_flexible.py, tests/multibody/bodies/test_beam_body.py,
tests/multibody/bodies/test_indefinite_stiffness.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError, true_or_false, unknown, within
from torchmbd.fem.elements import Assembly, MassPoints
from torchmbd.fem.reduction import REDUCTIONS, CraigBampton, Matrix, ModalBasis, StaticShapes, VibrationModes
from torchmbd.fem.reduction.forms import Indefinite
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.sparse import Pattern, SparseMatrix

MOST_NAMES = 8  # of nodes in a message
ROUNDING = 1e-12  # of the stiffness of a mode, relative to the sizes of its terms and to that of other modes


def matrices(assembly: Assembly, points: MassPoints | None = None) -> tuple[SparseMatrix, Matrix]:
    """Stiffness and mass of the free degrees of freedom, with the same lanes; points: `assembly.masses()`, if known.

    A lumped mass is its diagonal [..., N]; of N designs a sparse matrix, as [N, N] would be a dense one.
    """
    K, M = assembly.stiffness(), assembly.mass(points)
    values = M if isinstance(M, Tensor) else M.values
    lanes = np.broadcast_shapes(K.values.shape[:-1], values.shape[:-1])
    K = replace(K, values=K.values.expand(*lanes, -1))
    if isinstance(M, Tensor):
        M = values.expand(*lanes, -1)
        if lanes[-1:] == M.shape[-1:]:
            every = torch.arange(M.shape[-1])
            M = SparseMatrix(Pattern(every, every, len(every)), M, symmetric=True)
    return K, M


def reduced(
    name: str,
    assembly: Assembly,
    kind: str,
    modes: Any,
    interface: Sequence[int],
    reference: Sequence[int],
    updated: bool,
    shapes: StaticShapes | None = None,
) -> tuple[VibrationModes | CraigBampton, int]:
    """The reduction of a kind to `modes` modes, or a few more, and the number of the first design; arguments as in
    `FlexibleBody.plate`. Static shapes are added to the modes.

    Raises InputError for a kind that does not exist, a number of modes that the mesh does not have, and interface nodes
    that are references or come twice.
    """
    free = assembly.freedoms.free
    held = _rows(name, free, interface, reference)
    least, most = 0 if held else 1, len(free) - len(held)
    if not is_whole(modes) or not least <= modes <= most:
        allowed = f"a whole number, {least} to {most}, the degrees of freedom of the mesh"
        raise InputError((name, "modes"), modes, allowed)
    updated = true_or_false((name, "updated"), updated)
    if kind not in REDUCTIONS:
        raise unknown((name, "reduction"), kind, REDUCTIONS)
    try:
        reduction = REDUCTIONS[kind](int(modes), held, updated, shapes)
        with torch.no_grad():
            K, M = matrices(assembly)
            basis = reduction(K, M)
            _check_elastic(K, basis)
            return reduction, basis.stiffness.shape[-1]
    except Indefinite as error:
        state = f"{error.fault}, and {moving(assembly, error.row)}"
        raise InputError(
            (name, *error.path), allowed=error.allowed, noun=f"reduction of {name!r}:", state=state
        ) from None
    except InputError as error:
        raise within(f"reduction of {name!r}", _without_mass(assembly) or error, name) from None


def _check_elastic(K: SparseMatrix, basis: ModalBasis) -> None:
    """Raise Indefinite where the stiffness pushes a mode of the first design further."""
    values, shapes = torch.linalg.eigh(basis.stiffness.reshape(-1, *basis.stiffness.shape[-2:])[0])
    shape = basis.vectors.reshape(-1, *basis.vectors.shape[-2:])[0] @ shapes[:, :1]
    sizes = SparseMatrix(K.pattern, K.values.reshape(-1, K.pattern.nnz)[0].abs()) @ shape.abs()
    if len(values) and values[0] < -ROUNDING * torch.maximum((shape.abs() * sizes).sum(), values[-1]):
        fault = "lets something move against its stiffness"
        raise Indefinite("K", "", fault, int(shape.abs().argmax()))


def moving(assembly: Assembly, row: int) -> str:
    """A sentence about a free degree of freedom that moves: its node, its direction and the nodes beside it."""
    pattern, free, count = assembly.pattern, assembly.freedoms.free, len(assembly.mesh.nodes)
    node, direction = _freedom_name(assembly, int(free[row]))
    columns = pattern.column[int(pattern.start[row]) : int(pattern.start[row + 1])]
    beside = (free[columns] // 6).unique().tolist()
    labels = getattr(assembly.mesh, "node_labels", ())
    names = [labels[k] if labels else str(k) for k in beside if k != int(free[row]) // 6 and k < count]
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    others = ", ".join(names[:MOST_NAMES]) or "none"
    return f"{node} moves most, {direction}; its neighbors are {others}{more}"


def _freedom_name(assembly: Assembly, freedom: int) -> tuple[str, str]:
    """The node of a degree of freedom and its direction, as "node 3", "about x"."""
    node, component = divmod(freedom, 6)
    named = getattr(assembly.mesh, "node_name", lambda k: f"node {k}")(node)
    return named, _direction(component)


def _direction(component: int) -> str:
    return f"{'along' if component < 3 else 'about'} {'xyz'[component % 3]}"


def _without_mass(assembly: Assembly) -> InputError | None:
    """The error for the first degree of freedom with stiffness and without mass; None if there is none."""
    M = assembly.mass()
    if isinstance(M, SparseMatrix):
        on = M.pattern.rows == M.pattern.cols
        values = M.values.detach().new_zeros(len(assembly.freedoms.free))
        M = values.index_copy(0, M.pattern.rows[on], M.values.detach().reshape(-1, M.pattern.nnz)[0, on])
    bad = (M.detach().reshape(-1, len(assembly.freedoms.free))[0] <= 0).nonzero()[:, 0]
    if not len(bad):
        return None
    named, what = _freedom_name(assembly, int(assembly.freedoms.free[bad[0]]))
    state = f"has stiffness but no mass {what} ({len(bad)} such degrees of freedom)"
    return InputError("M", allowed="must have a mass or an inertia there", noun=named, state=state)


def twice(node: int, reference: Sequence[int]) -> str:
    """Why a node cannot be in the interface, for a message."""
    return f"has node {node}{', which is a reference node' if node in reference else ' twice'}"


def _rows(name: str, free: Tensor, interface: Sequence[int], reference: Sequence[int]) -> tuple[int, ...]:
    """Rows of the free degrees of freedom that belong to interface nodes."""
    for node in interface:
        if node in reference or list(interface).count(node) > 1:
            allowed = "nodes that are not references, each once"
            raise InputError((name, "interface"), interface, allowed, state=twice(node, reference))
    freedoms = torch.tensor([6 * node + i for node in interface for i in range(6)], dtype=torch.long)
    bound = freedoms[~torch.isin(freedoms, free)]
    if len(bound):
        node, i = divmod(int(bound[0]), 6)
        raise InputError(
            (name, "interface"),
            interface,
            "nodes that can move in all six directions",
            state=f"has node {node}, which has no stiffness {_direction(i)}, or follows other nodes there by a link",
            hint="the node that leads the link",
        )
    return tuple(torch.searchsorted(free, freedoms).tolist())
