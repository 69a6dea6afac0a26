"""The structure stage of a body that was reduced elsewhere: nodes, modes, reduced stiffness, inertia invariants.

Invariants by their names in fem/reduction/invariants.py: mass, S0 [3], P0 [3, 3], S1 [3, m], C0 [3, 3, m], C1 [3, 3, m, m];
mu, R1, R2 where there are rotary inertias; "J", the inertia about the origin, may stand for P0. The modal mass is the trace
of C1 + R2 over the axes, or Mr. Where it is not the identity, the eigenmodes of (Kr, Mr) become the coordinates. Elastic
forces are Kr w + 1/2 w' K2 w, with the energy 1/2 Kr ww + 1/6 K2 www.

File (.npz): nodes, psi, Kr, K2 where there is one, the invariants, cells and node sets; a round trip changes no digit.
Checked in tests/multibody/bodies/test_from_reduced.py.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, unknown, within
from torchmbd.fem.mesh import Mesh, NodeCloud
from torchmbd.fem.reduction import modal_basis
from torchmbd.math.checked_numbers import reals
from torchmbd.multibody.bodies.given_matrices import mesh_of

SHAPES: dict[str, tuple[str | int, ...]] = {
    "mass": (),
    "S0": (3,),
    "S1": (3, "m"),
    "P0": (3, 3),
    "C0": (3, 3, "m"),
    "C1": (3, 3, "m", "m"),
    "mu": (),
    "R1": (3, "m"),
    "R2": (3, 3, "m", "m"),
}
_OPTIONAL = ("mu", "R1", "R2")
_MESH = ("triangles", "quads", "lines")
NORMAL = 1e-9  # largest relative unsymmetry, and error of a modal mass that counts as the identity


class ReducedStructure:
    """Given modes and invariants, constant for all designs; arguments as in `FlexibleBody.from_reduced`."""

    module = None
    reference: Sequence[int] = ()

    def __init__(
        self,
        name: str,
        nodes: Any,
        modes: Any,
        Kr: Any,
        invariants: Mapping[str, Any],
        Mr: Any = None,
        node_sets: Mapping[str, Sequence[int]] | None = None,
        K2: Any = None,
    ) -> None:
        self.name = name
        x = nodes.nodes if isinstance(nodes, Mesh) else reals((name, "nodes"), nodes).detach()
        self.mesh = mesh_of(name, nodes, x, node_sets)
        self.origin = torch.zeros(3, dtype=torch.float64)
        psi = _shapes(name, len(x), modes)
        self.size = psi.shape[-1]
        structure = self._invariants(invariants)
        stiffness = self._symmetric_matrix("Kr", Kr)
        if K2 is not None:
            structure["K2"] = self._symmetric_cube(K2)
        if Mr is not None:
            rest = self._symmetric_matrix("Mr", Mr) - torch.einsum("iiab->ab", structure["C1"] + structure["R2"])
            structure["R2"] = structure["R2"] + torch.eye(3, dtype=torch.float64)[:, :, None, None] * (rest / 3.0)
        self._structure = self._normalized(structure, stiffness, psi)
        self._check()

    def structure(self) -> dict[str, Tensor]:
        """Invariants, "Kr" and "psi"."""
        return dict(self._structure)

    def _symmetric_matrix(self, key: str, matrix: Any) -> Float[Tensor, "m m"]:
        A = reals((self.name, key), matrix).detach()
        if A.shape != (self.size, self.size) or not bool(torch.isfinite(A).all()):
            raise InputError(
                (self.name, key),
                A,
                f"must have shape [{self.size}, {self.size}], finite",
                state=f"has shape {tuple(A.shape)}",
            )
        if float((A - A.T).abs().max()) > NORMAL * float(A.abs().max()):
            raise InputError(
                (self.name, key),
                allowed="symmetric to 1e-9",
                shown=str(A.tolist()),
            )
        return 0.5 * (A + A.T)

    def _symmetric_cube(self, cube: Any) -> Float[Tensor, "m m m"]:
        K2 = reals((self.name, "K2"), cube).detach()
        if K2.shape != (self.size,) * 3 or not bool(torch.isfinite(K2).all()):
            shape = tuple(K2.shape)
            raise InputError(
                (self.name, "K2"), allowed=f"must have shape {(self.size,) * 3}, finite", state=f"has shape {shape}"
            )
        if max(float((K2 - K2.transpose(0, k)).abs().max()) for k in (1, 2)) > NORMAL * float(K2.abs().max()):
            raise InputError(
                (self.name, "K2"),
                allowed="the third derivatives of an energy",
                state="is not symmetric: its numbers change if two of its axes are exchanged",
            )
        return K2

    def _invariants(self, numbers: Mapping[str, Any]) -> dict[str, Tensor]:
        if not isinstance(numbers, Mapping):
            raise InputError((self.name, "invariants"), numbers, "a mapping name -> numbers")
        values = dict(numbers)
        if "J" in values:
            J = reals((self.name, "J"), values.pop("J"))
            values.setdefault("P0", 0.5 * J.trace() * torch.eye(3, dtype=J.dtype) - J)
        for key in values:
            if key not in SHAPES:
                raise unknown((self.name, "invariant"), key, [*SHAPES, "J"])
        invariants = {}
        for key, axes in SHAPES.items():
            shape = tuple(self.size if n == "m" else int(n) for n in axes)
            if key not in values and key not in _OPTIONAL:
                raise InputError(
                    (self.name, "invariants"), allowed=f"must have all of {', '.join(SHAPES)}", state=f"lack {key!r}"
                )
            x = reals((self.name, key), values.get(key, np.zeros(shape))).detach()
            if x.shape != shape or not bool(torch.isfinite(x).all()):
                raise InputError(
                    (self.name, key), x, f"must have shape {shape}, finite", state=f"has shape {tuple(x.shape)}"
                )
            invariants[key] = x
        return invariants

    def flexibility(self) -> None:
        """None: the stiffness of the degrees of freedom of nodes is not known."""
        return None

    def _normalized(self, invariants: dict[str, Tensor], Kr: Tensor, psi: Tensor) -> dict[str, Tensor]:
        """The structure in modal coordinates whose mass is the identity."""
        Mr = torch.einsum("iiab->ab", invariants["C1"] + invariants["R2"])
        eye = torch.eye(self.size, dtype=torch.float64)
        if float((Mr - eye).abs().max()) > NORMAL:
            try:
                small = modal_basis(Kr, 0.5 * (Mr + Mr.T), self.size)
            except InputError as error:
                raise within(
                    f"modal mass of {self.name!r} (the trace of C1 + R2, or Mr)", error, self.name, "invariants"
                ) from None
            A, Kr = small
            psi = psi @ A
            invariants |= {key: invariants[key] @ A for key in ("S1", "C0", "R1")}
            invariants |= {key: A.T @ invariants[key] @ A for key in ("C1", "R2")}
            if "K2" in invariants:
                invariants["K2"] = torch.einsum("abc,ai,bj,ck->ijk", invariants["K2"], A, A, A)
        return invariants | {"Kr": Kr, "psi": psi}

    def _check(self) -> None:
        structure = self._structure
        P0 = structure["P0"]
        J = (P0.trace() + structure["mu"]) * torch.eye(3, dtype=torch.float64) - P0
        lowest = {
            "mass": float(structure["mass"]),
            "Kr": float(torch.linalg.eigvalsh(structure["Kr"])[0]),
            "inertia about the origin": float(torch.linalg.eigvalsh(0.5 * (J + J.T))[0]),
        }
        for key, value in lowest.items():
            if not value > (0.0 if key != "inertia about the origin" else -1e-12 * float(J.abs().max())):
                raise InputError(
                    (self.name, key),
                    allowed="positive definite",
                    state=f"has the eigenvalue {value:g}",
                )


def _shapes(name: str, n: int, modes: Any) -> Float[Tensor, "n 6 m"]:
    """Modes [n, 6, m]; of three rows for each node the rotations are zero."""
    psi = reals((name, "modes"), modes).detach()
    if psi.dim() == 2 and psi.shape[0] in (3 * n, 6 * n):
        psi = psi.unflatten(0, (n, -1))
    if psi.dim() != 3 or psi.shape[0] != n or psi.shape[1] not in (3, 6) or not bool(torch.isfinite(psi).all()):
        raise InputError(
            (name, "modes"),
            psi,
            f"must have shape [{n}, 6, m], or [{n}, 3, m] of displacements",
            state=f"have shape {tuple(psi.shape)}",
        )
    return torch.cat([psi, psi.new_zeros(n, 6 - psi.shape[1], psi.shape[2])], dim=1)


def save_reduced(path: str | Path, mesh: Any, origin: Tensor, structure: Mapping[str, Tensor]) -> Path:
    """Write a reduced body to an .npz file; nodes are measured from the origin of its frame."""
    if not isinstance(path, (str, Path)) or Path(path).suffix != ".npz":
        raise InputError("path", str(path), "a name that ends in .npz")
    path = Path(path)
    if "F1" in structure:
        raise InputError("stiffening", True, "False, because files of reduced bodies cannot store stiffening")
    if structure["Kr"].dim() > 2:
        raise InputError(
            "designs",
            structure["Kr"].shape[0],
            "must have one design",
            noun="the body",
            state=f"has {structure['Kr'].shape[0]} designs at once",
        )
    arrays = {key: structure[key].detach().numpy() for key in (*SHAPES, "Kr", "psi", "K2") if key in structure}
    arrays["nodes"] = (mesh.nodes - origin).detach().numpy()
    lines = getattr(mesh, "elements", None)
    cells = {"lines": lines} if lines is not None else {key: getattr(mesh, key) for key in _MESH}
    arrays |= {key: x.numpy() for key, x in cells.items()}
    sets = {key: [int(k) for k in members] for key, members in mesh.node_sets.items()}
    arrays["node_sets"] = np.array(json.dumps(sets))
    np.savez(path, allow_pickle=False, **arrays)
    return path


def read_reduced(name: str, path: str | Path) -> ReducedStructure:
    """Read a file of `save_reduced`; InputError for other files."""
    if not Path(path).is_file():
        raise InputError((name, "nodes"), str(path), "a file of save_reduced that exists, or numbers")
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files}
        sets = json.loads(str(data["node_sets"]))
        cells: dict[str, Any] = {key: torch.from_numpy(data[key]).long() for key in _MESH if key in data}
        mesh = NodeCloud(torch.from_numpy(data["nodes"]), node_sets=sets, **cells)
        invariants = {key: data[key] for key in SHAPES}
        return ReducedStructure(name, mesh, data["psi"], data["Kr"], invariants, K2=data.get("K2"))
    except (
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        OSError,
        EOFError,
        MemoryError,
        zipfile.BadZipFile,
    ) as error:
        raise (
            error
            if isinstance(error, InputError)
            else InputError(Path(path).name, allowed="a file of save_reduced", state=f"is not a reduced body: {error}")
        ) from None
