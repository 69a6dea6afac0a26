"""Methods of FlexibleBody for matrices: bodies made of given ones, and files for other programs.

Checked in tests/multibody/bodies/test_from_matrices.py, tests/multibody/bodies/test_from_reduced.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from torchmbd.multibody.bodies.export import assembled, save_matrices
from torchmbd.multibody.bodies.frame import bend, identifier, put
from torchmbd.multibody.bodies.given_matrices import GivenMatrices
from torchmbd.multibody.bodies.matrix_structure import MatrixStructure
from torchmbd.multibody.bodies.modal_damping import ModalDamping
from torchmbd.multibody.bodies.reduced_structure import ReducedStructure, read_reduced, save_reduced


class MatrixMethods:
    """What a FlexibleBody can do with matrices; `given` is None for a body of elements."""

    given: MatrixStructure | ReducedStructure | None = None
    stiffening: Any = None
    mesh: Any
    origin: Any
    structure: Any

    @classmethod
    def from_matrices(
        cls,
        name: str,
        M: Any,
        K: Any = None,
        nodes: Any = None,
        modes: Any = 8,
        interface: str | int | Sequence[str | int] = (),
        freedoms: Any = None,
        derivatives: Mapping[str, tuple[Any, Any, Any]] | None = None,
        parameters: Mapping[str, float | Tensor] | None = None,
        node_sets: Mapping[str, Sequence[int]] | None = None,
        reference: str | int | Sequence[int] | None = None,
        reduction: str | None = None,
        updated: bool = True,
        **options: Any,
    ) -> Self:
        """A body from the mass and stiffness matrices of another program: free of supports, linear, in m, kg, s, N.

        M, K         arrays, tensors, SciPy sparse matrices or files (Matrix Market, Nastran OP4 and DMIG text, Abaqus .mtx); or
                     M alone, a torch module, or a function of `parameters`, that returns both, dense [N, N]
        nodes        places [n, 3] [m], label -> place, or a Mesh (for pictures and names)
        modes        how many modes with the reference held, besides the constraint modes of `interface` (Craig-Bampton);
                     or shapes [N, m] that the body deforms by
        freedoms     3 or 6 for each node (None: what fits), or (node, "x" ... "rz") of each row
        derivatives  name -> (value, dM, dK): design variables "body.model.name"; None for a matrix that does not change
        reference    nodes that the body frame is fixed to; None: the one nearest to the center of mass, and what else it takes
        options      position, axes, damping, as in `plate`
        Assumptions of inertia: fem/reduction/mass_invariants.py
        Raises InputError: not symmetric, not positive definite, wrong size, forces for rigid motions. Warns of implausible
        units.
        """
        made = GivenMatrices(name, M, K, nodes, freedoms, derivatives, parameters, node_sets)
        return cls._of(name, MatrixStructure(made, modes, reference, reduction, interface, updated), **options)

    @classmethod
    def from_reduced(
        cls,
        name: str,
        nodes: Any,
        modes: Any = None,
        Kr: Any = None,
        invariants: Mapping[str, Any] | None = None,
        Mr: Any = None,
        node_sets: Mapping[str, Sequence[int]] | None = None,
        K2: Any = None,
        **options: Any,
    ) -> Self:
        """A body that was reduced elsewhere, of constant numbers (multibody/bodies/reduced_structure.py).

        nodes        places from the origin of the body frame [n, 3] [m], a Mesh, or a file of `save_reduced` alone
        modes        at the nodes [n, 6, m], or [n, 3, m] without rotations
        Kr, Mr       reduced stiffness and mass [m, m]; Mr None: the trace of C1 + R2
        invariants   inertia invariants by their names
        K2           quadratic stiffness, symmetric [m, m, m]: elastic forces Kr w + 1/2 w' K2 w; None: linear
        options      position, axes, damping, as in `plate`
        """
        if isinstance(nodes, (str, Path)) and invariants is None:
            return cls._of(name, read_reduced(name, nodes), **options)
        made = ReducedStructure(name, nodes, modes, Kr, {} if invariants is None else invariants, Mr, node_sets, K2)
        return cls._of(name, made, **options)

    @classmethod
    def _of(
        cls,
        name: str,
        given: MatrixStructure | ReducedStructure,
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        damping: float = 0.0,
    ) -> Self:
        body: Any = cls.__new__(cls)
        nn.Module.__init__(body)
        body.name = identifier("flexible body", name)
        body.given, body.mesh, body.parts, body.interfaces = given, given.mesh, {}, {}
        put(body, position, axes)
        body.reference, body.origin, body.modes = list(given.reference), given.origin, given.size
        if given.module is not None:
            body.add_module("model", given.module)
        body.damping = ModalDamping(name, damping)
        bend(body, None, None)
        return body

    def mass_and_stiffness(self) -> tuple[Any, Any]:
        """M and K of all six freedoms of all nodes, none held, as SciPy sparse matrices (multibody/bodies/export.py)."""
        return assembled(self)

    def save_matrices(self, path: str | Path) -> tuple[Path, Path]:
        """Write these as Matrix Market files path_M.mtx and path_K.mtx; from_matrices reads them."""
        return save_matrices(self, path)

    def save_reduced(self, path: str | Path) -> Path:
        """Write nodes, modes, Kr and invariants of the present design as .npz; from_reduced reads it, digit by digit."""
        with torch.no_grad():
            return save_reduced(path, self.mesh, self.origin, self.structure())
