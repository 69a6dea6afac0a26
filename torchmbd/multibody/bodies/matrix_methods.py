"""Methods of FlexibleBody for matrices: bodies made of given ones, and files for other programs.

Checked in tests/multibody/bodies/test_from_matrices.py, tests/multibody/bodies/test_from_reduced.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import scipy.io
import scipy.sparse
import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements import Assembly
from torchmbd.fixed_arguments import fix_arguments
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies.frame import identifier, set_modal_start, set_start
from torchmbd.multibody.bodies.given_matrices import GivenMatrices
from torchmbd.multibody.bodies.matrix_structure import MatrixStructure
from torchmbd.multibody.bodies.modal_damping import ModalDamping
from torchmbd.multibody.bodies.reduced import matrices
from torchmbd.multibody.bodies.reduced_structure import ReducedStructure, read_reduced, save_reduced


class MatrixMethods:
    """Methods of FlexibleBody for matrices.

    given_structure   the structure stage of a body of given matrices or modes; None: a body of elements
    """

    given_structure: MatrixStructure | ReducedStructure | None = None
    stiffening: Any = None
    expansion: Any = None
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

        M, K         arrays, tensors, SciPy sparse matrices or what mbd.io.read_matrix reads; or M alone, a torch module, or a
                     function of `parameters`, that returns both, dense [N, N]
        nodes        positions [n, 3] [m], label -> position, or a Mesh (for pictures and names)
        modes        number of modes with the reference held, besides the constraint modes of `interface` (Craig-Bampton);
                     or the shapes [N, m] of the modes
        freedoms     3 or 6 for each node (None: by the size of M), or (node, "x" ... "rz") of each row
        derivatives  name -> (value, dM, dK): design variables "body.model.name"; None for a matrix that does not change
        reference    nodes that the body frame is fixed to; None: the node nearest to the center of mass, with degrees of
                     freedom of others where it has no rotations
        options      position, axes, damping, as in `plate`
        Assumptions of inertia: fem/reduction/mass_invariants.py
        Raises InputError for matrices that are not symmetric or not positive definite, have a wrong size, or resist rigid
        motions. Warns of implausible units.
        """
        matrices = GivenMatrices(name, M, K, nodes, freedoms, derivatives, parameters, node_sets)
        return cls._of(name, MatrixStructure(matrices, modes, reference, reduction, interface, updated), **options)

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

        nodes        positions from the origin of the body frame [n, 3] [m], a Mesh, or a file of `save_reduced` alone
        modes        at the nodes [n, 6, m], or [n, 3, m] without rotations
        Kr, Mr       reduced stiffness and mass [m, m]; Mr None: the trace of C1 + R2
        invariants   inertia invariants by their names
        K2           quadratic stiffness, symmetric [m, m, m]: elastic forces Kr w + 1/2 w' K2 w; None: linear
        options      position, axes, damping, as in `plate`
        """
        if isinstance(nodes, (str, Path)) and invariants is None:
            arguments = {"modes": modes, "Kr": Kr, "Mr": Mr, "node_sets": node_sets, "K2": K2}
            if beside := [key for key, x in arguments.items() if x is not None]:
                raise InputError(
                    (name, beside[0]),
                    allowed="left out with a file",
                    state="are given together with a file, which contains them",
                    noun=f"{', '.join(beside)} of {name!r}",
                )
            return cls._of(name, read_reduced(name, nodes), **options)
        structure = ReducedStructure(
            name, nodes, modes, Kr, {} if invariants is None else invariants, Mr, node_sets, K2
        )
        return cls._of(name, structure, **options)

    @classmethod
    def _of(
        cls,
        name: str,
        structure: MatrixStructure | ReducedStructure,
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        damping: float | Tensor = 0.0,
    ) -> Self:
        body: Any = cls.__new__(cls)
        nn.Module.__init__(body)
        body.name = identifier("flexible body", name)
        body.given_structure, body.mesh, body.parts, body.interfaces = structure, structure.mesh, {}, {}
        set_start(body, position, axes)
        body.reference, body.origin, body.modes = list(structure.reference), structure.origin, structure.size
        if structure.module is not None:
            body.add_module("model", structure.module)
        body.damping = ModalDamping(name, damping)
        set_modal_start(body, None, None)
        fix_arguments(body)
        return body

    def mass_and_stiffness(self) -> tuple[Any, Any]:
        """M and K [6 n, 6 n] of the present design, without supports, as SciPy sparse matrices; rows 6 * node + i.

        InputError for bodies without matrices of their nodes.
        """
        body: Any = self
        with torch.no_grad():
            if self.given_structure is not None:
                if not isinstance(self.given_structure, MatrixStructure):
                    raise InputError(
                        (body.name,),
                        allowed="a body of elements or matrices",
                        noun=f"body {body.name!r}",
                        state="has no matrices of its nodes, because another program reduced it",
                    )
                M, K = self.given_structure.matrices.now()
            else:
                if not body.assembly.freedoms.plain:
                    raise InputError(
                        (body.name, "nodes"),
                        allowed="free of links",
                        state="are linked, so that M and K have no rows of the nodes that follow",
                        hint="save_reduced, which saves the reduced body",
                    )
                K, M = matrices(Assembly(self.mesh, body.assembly.parts))
        if K.values.dim() > 1:
            raise InputError(
                (body.name,),
                allowed="a body with one design",
                noun=f"body {body.name!r}",
                state=f"has {K.values.shape[0]} designs at once",
            )
        mass = M.pattern.to_scipy(M.values) if isinstance(M, SparseMatrix) else scipy.sparse.diags_array(M.numpy())
        return scipy.sparse.csr_array(mass), scipy.sparse.csr_array(K.pattern.to_scipy(K.values))

    def save_matrices(self, path: str | Path) -> tuple[Path, Path]:
        """Write these as Matrix Market files path_M.mtx and path_K.mtx; mbd.io.read_matrix reads them."""
        files = Path(f"{path}_M.mtx"), Path(f"{path}_K.mtx")
        for file, matrix in zip(files, self.mass_and_stiffness(), strict=True):
            with file.open("wb") as handle:
                scipy.io.mmwrite(handle, scipy.sparse.coo_array(matrix), precision=17, symmetry="symmetric")
        return files

    def save_reduced(self, path: str | Path) -> Path:
        """Write nodes, modes, Kr and invariants of the present design as .npz; from_reduced reads the same digits."""
        with torch.no_grad():
            return save_reduced(path, self.mesh, self.origin, self.structure())
