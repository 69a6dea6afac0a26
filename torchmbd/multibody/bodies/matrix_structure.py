"""The structure stage of a body whose mass and stiffness matrices are given (given_matrices.py).

    M, K over all degrees of freedom -> rows of the free degrees of freedom -> modes psi, Kr -> inertia invariants of M

The body frame is fixed to the reference nodes, whose degrees of freedom are all held; without a reference, to the node
nearest to the center of mass. If that node has no rotations, its three displacements and three degrees of freedom of other
nodes are held, so that the body is supported statically determined. With given modes no degree of freedom is held.

Nodes without rotations in the matrices get rotations by a least-squares fit of the displacements of the nodes that K couples
with them; frames on such a node turn with these.
Checked in tests/multibody/bodies/test_from_matrices.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, true_or_false, unknown, warn, within
from torchmbd.fem.reduction import REDUCTIONS, CraigBampton, CutCluster, VibrationModes, modal_basis
from torchmbd.fem.reduction.forms import Indefinite
from torchmbd.fem.reduction.mass_invariants import has_isotropic_inertia, mass_invariants, rigid_motions
from torchmbd.math.checked_numbers import is_whole, reals
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies.fitted_rotations import FittedRotations
from torchmbd.multibody.bodies.given_matrices import GivenMatrices, freedom
from torchmbd.multibody.bodies.interpolation import node_indices
from torchmbd.multibody.bodies.reduced import twice

RIGID = 1e-5  # largest forces of a rigid motion, relative to the sum of the sizes of their terms
ISOTROPIC = 1e-6  # largest relative difference of the masses along the three axes


class MatrixStructure:
    """Modes and invariants of given matrices; arguments as in `FlexibleBody.from_matrices`.

    mesh, module   of GivenMatrices;  reference  nodes;  origin [3];  size  number of modes
    """

    def __init__(
        self,
        matrices: GivenMatrices,
        modes: Any,
        reference: str | int | Sequence[int] | None,
        reduction: str | None,
        interface: str | int | Sequence[str | int],
        updated: bool,
    ) -> None:
        self.matrices, self.name, self.mesh, self.module = matrices, matrices.name, matrices.mesh, matrices.module
        updated = true_or_false((self.name, "updated"), updated)
        with torch.no_grad():
            M, K = matrices.now()
            x = self.mesh.nodes
            self._arms = not has_isotropic_inertia(M)
            self._check_rigid(M, K, rigid_motions(x - x.mean(0)))
            self.reference, held = self._held(M, reference)
            self.origin = x[self.reference].mean(0)
            used = torch.zeros(M.size, dtype=torch.bool)
            used[matrices.freedoms] = True
            empty = (_diagonal(K) == 0) & (_diagonal(M) == 0)  # such as drilling rotations of some programs
            used &= ~empty
            self._rotations = FittedRotations(x, matrices.pairs(), ~used.reshape(-1, 6)[:, 3:].any(1))
            self._held_rows = torch.tensor(held, dtype=torch.long)
            self.shapes = None if is_whole(modes) else self._given_shapes(modes)
            if self.shapes is None:
                used[self._held_rows] = False
                self.free = used.nonzero()[:, 0]
                self._prepare(M, K, modes, reduction, interface, updated)
            elif reduction is not None or node_indices(self.mesh, interface):
                raise InputError(
                    (self.name, "reduction"),
                    allowed="left out with shapes",
                    state="are given, although modes contains shapes",
                    noun=f"reduction and interface of {self.name!r}",
                )
            self._warn_units(self._reduce())

    def _reduce(self) -> dict[str, Tensor]:
        """The structure of the first design, which has the number of modes."""
        first = self._compute()
        self.size = first["Kr"].shape[-1]
        self._constant = first if self.module is None else None  # without design variables: that of all designs
        return first

    def pencil(self) -> tuple[SparseMatrix, SparseMatrix]:
        """Stiffness and mass of the free degrees of freedom; where the modes are not given."""
        M, K = self.matrices.now()
        return K.restrict(self.free), M.restrict(self.free)

    def keep(self, reduction: VibrationModes | CraigBampton) -> None:
        """Have another reduction of the free degrees of freedom."""
        self.reduction = reduction
        with torch.no_grad():
            self._reduce()

    def structure(self) -> dict[str, Tensor]:
        """Invariants, "Kr" [..., m, m], "psi" [..., nodes, 6, m] of the present design."""
        return self._compute() if self._constant is None else dict(self._constant)

    def _compute(self) -> dict[str, Tensor]:
        M, K = self.matrices.now()
        vectors, Kr = self._basis(M, K)
        psi = self._rotations(vectors.unflatten(-2, (-1, 6)))
        return mass_invariants(self.mesh.nodes - self.origin, M, psi, self._arms) | {"Kr": Kr, "psi": psi}

    def flexibility(self) -> tuple[SparseMatrix, Callable[[Tensor], Tensor]] | None:
        """See FlexibleBody. None where the caller supplies the modes: no degree of freedom is held then."""
        if self.shapes is not None:
            return None
        with torch.no_grad():
            K = self.matrices.now()[1].restrict(self.free)

        def expand(u: Tensor) -> Tensor:
            full = u.new_zeros(6 * len(self.mesh.nodes), u.shape[-1]).index_copy(-2, self.free, u)
            return self._rotations(full.unflatten(-2, (-1, 6)))

        return SparseMatrix(K.pattern, K.values.reshape(-1, K.pattern.nnz)[0].detach(), symmetric=True), expand

    def _basis(self, M: SparseMatrix, K: SparseMatrix) -> tuple[Tensor, Tensor]:
        """Modes [..., 6 n, m] and Kr [..., m, m]."""
        if self.shapes is not None:
            Mr, Kr = (self.shapes.mT @ (A @ self.shapes) for A in (M, K))
            try:
                small = modal_basis(0.5 * (Kr + Kr.mT), 0.5 * (Mr + Mr.mT), self.shapes.shape[1])
            except InputError as error:
                raise InputError((self.name, "modes"), allowed=f"independent: {error}") from None
            return self.shapes @ small.vectors, small.stiffness
        try:
            basis = self.reduction(K.restrict(self.free), M.restrict(self.free))
        except CutCluster as error:
            raise error.of_body(self.name) from None
        lanes = basis.vectors.shape[:-2]
        full = basis.vectors.new_zeros(*lanes, M.size, basis.vectors.shape[-1])
        return full.index_copy(-2, self.free, basis.vectors), basis.stiffness

    def _prepare(self, M: SparseMatrix, K: SparseMatrix, modes: Any, kind: Any, interface: Any, updated: bool) -> None:
        """Choose the reduction as in reduced.py; InputError for its arguments and for singular matrices."""
        nodes = node_indices(self.mesh, interface)
        for node in nodes:
            if node in self.reference or nodes.count(node) > 1:
                allowed = "nodes that are not references, each once"
                raise InputError(
                    (self.name, "interface"),
                    interface,
                    allowed,
                    state=twice(node, self.reference),
                )
        rows = torch.isin(self.free // 6, torch.tensor(nodes, dtype=torch.long)).nonzero()[:, 0].tolist()
        kind = ("craig-bampton" if rows else "vibration") if kind is None else kind
        if kind not in REDUCTIONS:
            raise unknown((self.name, "reduction"), kind, REDUCTIONS)
        most = len(self.free) - len(rows)
        if not (0 if rows else 1) <= int(modes) <= most:
            raise InputError((self.name, "modes"), modes, f"a whole number up to {most}, or shapes")
        for key, A in (("M", M), ("K", K)):
            bad = self.free[_diagonal(A)[self.free] <= 0]
            if len(bad):
                raise InputError(
                    (self.name, key),
                    allowed="must have mass and stiffness at every degree of freedom",
                    state=f"has {float(_diagonal(A)[bad[0]]):g} at {freedom(int(bad[0]))} (one of {len(bad)})",
                )
        try:
            reduction = REDUCTIONS[kind](int(modes), tuple(rows), updated)
            basis = reduction(K.restrict(self.free), M.restrict(self.free))
        except Indefinite as error:
            moving = freedom(int(self.free[error.row]))
            state, noun = f"{error.fault}, and {moving} moves most", f"reduction of {self.name!r}:"
            raise InputError((self.name, *error.path), allowed=error.allowed, noun=noun, state=state) from None
        except InputError as error:
            place = f"reduction of {self.name!r} (rows of its {len(self.free)} free degrees of freedom)"
            raise within(place, error, self.name) from None
        self.reduction = reduction
        lowest, shapes = torch.linalg.eigh(basis.stiffness)
        scale = float((_diagonal(K)[self.free] / _diagonal(M)[self.free]).max())
        if not float(lowest[0]) > 1e-12 * scale:
            moving = freedom(int(self.free[(basis.vectors @ shapes[:, 0]).abs().argmax()]))
            raise InputError(
                (self.name, "K"),
                K,
                "the stiffness of an elastic body in one piece",
                state=f"lets {moving} move without force while the reference is held (eigenvalue {float(lowest[0]):g} 1/s2)",
            )

    def _check_rigid(self, M: SparseMatrix, K: SparseMatrix, rigid: Tensor) -> None:
        """InputError if K has forces for rigid motions, or M different masses along the axes."""
        used = torch.zeros(M.size, 1, dtype=torch.float64)
        used[self.matrices.freedoms] = 1.0
        rigid = rigid * used
        sizes = SparseMatrix(K.pattern, K.values.abs()) @ rigid.abs()
        share = ((K @ rigid).abs() / sizes.amax().clamp_min(1e-300)).amax(0)
        if float(share.max()) > RIGID:
            motion = ("translation x", "translation y", "translation z", "rotation x", "rotation y", "rotation z")
            raise InputError(
                (self.name, "K"),
                allowed="the matrix of the body without supports, with rows in the order of the nodes, in their units",
                state=f"resists a rigid {motion[int(share.argmax())]} of the body (relative force {float(share.max()):.1e})",
            )
        masses = torch.einsum("ni,ni->i", rigid[:, :3], M @ rigid[:, :3])
        if not float(masses.min()) > 0 or float(masses.max() - masses.min()) > ISOTROPIC * float(masses.max()):
            raise InputError(
                (self.name, "M"),
                M,
                "must have the same positive mass along x, y and z",
                state=f"has the masses {masses.tolist()} kg along x, y, z",
            )

    def _held(self, M: SparseMatrix, reference: Any) -> tuple[list[int], list[int]]:
        """Reference nodes, and the degrees of freedom that are held."""
        x = self.mesh.nodes
        present = torch.zeros(M.size, dtype=torch.bool)
        present[self.matrices.freedoms] = True
        rigid = rigid_motions(x - x.mean(0))
        size = float((x - x.mean(0)).norm(dim=1).max()) or 1.0
        rigid[:, 3:] /= size
        if reference is not None:
            nodes = node_indices(self.mesh, reference)
            held = [6 * k + i for k in nodes for i in range(6) if present[6 * k + i]]
            if not nodes or torch.linalg.matrix_rank(rigid[held], rtol=1e-9) < 6:
                raise InputError(
                    (self.name, "reference"),
                    reference,
                    "a node with rotations, or at least three nodes that are not on a line",
                    state=f"is {reference!r}, which leaves the body movable",
                )
            return nodes, held
        T, moments = rigid_motions(x)[:, :3], rigid_motions(x)
        mass = float((T[:, 0] * (M @ T[:, :1])[:, 0]).sum())
        MR = T.mT @ (M @ moments[:, 3:])
        center = torch.stack([MR[1, 2] - MR[2, 1], MR[2, 0] - MR[0, 2], MR[0, 1] - MR[1, 0]]) / (2.0 * mass)
        full = present.reshape(-1, 6)[:, :3].all(1)
        if not full.any():
            raise InputError(
                (self.name, "nodes"),
                allowed="must have at least one node with three displacements",
                state="have rows of one or two displacements only",
            )
        distance = (x - center).square().sum(1)
        distance[~full] = torch.inf
        node = int(distance.argmin())
        if present[6 * node : 6 * node + 6].all():
            return [node], list(range(6 * node, 6 * node + 6))
        first = [6 * node + i for i in range(3)]
        turning = rigid_motions(x - x[node])[:, 3:] / size * present[:, None]
        _, R, order = scipy.linalg.qr(  # pyright: ignore[reportAssignmentType]
            turning.T.numpy(), mode="economic", pivoting=True
        )
        if abs(R[2, 2]) < 1e-9 * abs(R[0, 0]):
            raise InputError(
                (self.name, "nodes"),
                allowed="must not lie on a line, or must have rotations",
                state="lie on a line and have no rotations",
            )
        return [node], [*first, *(int(k) for k in order[:3])]

    def _given_shapes(self, modes: Any) -> Float[Tensor, "6n m"]:
        """Given modes on all degrees of freedom."""
        shapes = reals((self.name, "modes"), modes)
        rows = len(self.matrices.freedoms)
        if shapes.dim() != 2 or shapes.shape[0] != rows or not 0 < shapes.shape[1] <= rows:
            raise InputError(
                (self.name, "modes"),
                shapes,
                f"a number, or shapes [{rows}, m]",
                state=f"have shape {tuple(shapes.shape)}",
            )
        full = torch.zeros(6 * len(self.mesh.nodes), shapes.shape[1], dtype=torch.float64)
        full[self.matrices.freedoms] = shapes.detach()
        return full

    def _warn_units(self, structure: dict[str, Tensor]) -> None:
        x = self.mesh.nodes
        size = float((x.amax(0) - x.amin(0)).norm())
        mass = float(structure["mass"].reshape(-1)[0])
        values = torch.linalg.eigvalsh(structure["Kr"]).reshape(-1)
        if float(values[0]) <= 1e-12 * float(values[-1]):
            raise InputError(
                (self.name, "modes"),
                allowed="shapes that deform the body, without rigid motions",
                state=f"contain a shape without stiffness (eigenvalues {float(values[0]):g} to {float(values[-1]):g} 1/s2)",
            )
        first = math.sqrt(float(values[0])) / (2.0 * math.pi)
        density, sound = mass / size**3, first * size
        implausible = not 2e-3 <= size <= 200.0 or not 1e-4 <= density <= 25_000.0 or not 1e-3 <= sound <= 3e4
        if implausible:
            warn(
                f"units of body {self.name!r}? It is {size:.3g} m long, weighs {mass:.3g} kg, and its first frequency "
                f"is {first:.3g} Hz. Try: matrices in m, kg, s, N"
            )


def _diagonal(A: SparseMatrix) -> Tensor:
    on = A.pattern.rows == A.pattern.cols
    values = A.values[..., on].reshape(-1, int(on.sum()))[0]
    return torch.zeros(A.size, dtype=torch.float64).index_copy(0, A.pattern.rows[on], values)
