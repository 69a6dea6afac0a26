"""What a flexible body is made of: parts with stiffness and mass on common nodes, and the freedoms that are free.

    K(b) = sum_parts coefficients_p(b) @ basis_p        on the free freedoms, one sparsity pattern
    M(b) = sum of mass points: at nodes (lumped, diagonal) or halfway between two nodes

A part knows its pattern over all freedoms 6 * node + i of the mesh, and its basis, both made once; its coefficients
depend on the design, and their number does not grow with the mesh. A new kind of element is one class that keeps
this contract (`Part`).

Mass points: mass m and isotropic rotary inertia mu at a node, eq. (2), or at the middle of two nodes, which moves with
their mean. With three such points at the middles of its sides a triangle has its consistent mass, exact for linear
shape functions.
Differentiable, forward and reverse, in the parameters of the parts, with lanes.
Checked in tests/elements/test_assembly.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.elements.freedoms import Average, Freedoms, RigidLink
from torchmbd.mesh import Mesh
from torchmbd.numerics.sparse import Pattern, SparseMatrix


class MassPoints(NamedTuple):
    """Point masses [kg] and rotary inertias [kg m2] at the middles of node pairs; a pair (k, k) is node k."""

    ends: Int[Tensor, "points 2"]
    mass: Float[Tensor, "*lanes points"]
    rotary: Float[Tensor, "*lanes points"]


class Part(Protocol):
    """What an assembly asks of a part. K values on `pattern` (size 6 * nodes of the mesh) are coefficients() @ basis."""

    pattern: Pattern
    basis: Float[Tensor, "coefficients nnz"]

    def coefficients(self) -> Float[Tensor, "*lanes coefficients"]:
        """Numbers of the present design."""
        ...

    def masses(self) -> MassPoints:
        """Masses of the present design."""
        ...

    def modules(self) -> dict[str, nn.Module]:
        """Whose parameters are the design: the body registers them under these names."""
        ...


class Assembly:
    """Parts on the nodes of one mesh, some of them held or linked.

    mesh    whose nodes carry the freedoms
    parts   name -> part
    held    nodes that are fixed
    links   nodes that follow others
    """

    def __init__(
        self,
        mesh: Mesh,
        parts: Mapping[str, Part],
        held: Sequence[int] = (),
        links: Sequence[RigidLink | Average] = (),
    ) -> None:
        self.mesh, self.parts = mesh, dict(parts)
        self.freedoms = Freedoms(mesh.nodes, held, links)
        self._ends = torch.cat([part.masses().ends for part in self.parts.values()])
        self._lumped = bool((self._ends[:, 0] == self._ends[:, 1]).all())
        self._prepare_stiffness()
        self.diagonal = self._lumped and self.freedoms.plain
        if not self.diagonal:
            self._prepare_mass()

    def _prepare_stiffness(self) -> None:
        """The basis of every part on the free freedoms, and where its values go in the common pattern."""
        patterns, self._bases = [], []
        for part in self.parts.values():
            pattern, source, slot, factor = self.freedoms.reduced(part.pattern)
            if self.freedoms.plain:
                basis = part.basis[:, source].contiguous()
            else:
                basis = part.basis.new_zeros(len(part.basis), pattern.nnz)
                basis = basis.index_add(1, slot, part.basis[:, source] * factor)
            patterns.append(pattern)
            self._bases.append(basis)
        N = len(self.freedoms.free)
        if len(patterns) == 1:
            self.pattern, self._slots = patterns[0], [torch.arange(patterns[0].nnz)]
            return
        rows, cols = (torch.cat([getattr(p, name) for p in patterns]) for name in ("rows", "cols"))
        self.pattern, slot = Pattern.gather(rows, cols, N)
        self._slots = list(slot.split([p.nnz for p in patterns]))

    def _prepare_mass(self) -> None:
        """Where each mass point goes in M: a quarter to the four corners of its pair, of every freedom."""
        ends, six = self._ends, torch.arange(6)
        pairs = torch.stack([ends[:, [0, 0, 1, 1]], ends[:, [0, 1, 0, 1]]], dim=-1)  # [points, 4, 2]
        rows, cols = (6 * pairs[..., k, None] + six for k in (0, 1))  # [points, 4, 6]
        pattern, entry = Pattern.gather(rows.flatten(), cols.flatten(), 6 * len(self.mesh.nodes))
        self.mass_pattern, source, slot, factor = self.freedoms.reduced(pattern)
        # M values = sum over (point, corner, freedom) with the weight 1/4, then through T.
        self._mass_entry, self._mass_size = entry, pattern.nnz
        self._mass_source, self._mass_slot, self._mass_factor = source, slot, factor

    def stiffness(self) -> SparseMatrix:
        """K of the free freedoms."""
        values = [part.coefficients() @ basis for part, basis in zip(self.parts.values(), self._bases, strict=True)]
        if len(values) == 1:
            return SparseMatrix(self.pattern, values[0])
        lanes = torch.broadcast_shapes(*(v.shape[:-1] for v in values))
        total = values[0].new_zeros(*lanes, self.pattern.nnz)
        for slot, v in zip(self._slots, values, strict=True):
            total = total.index_add(-1, slot, v.expand(*lanes, -1))
        return SparseMatrix(self.pattern, total)

    def masses(self) -> MassPoints:
        """All mass points."""
        points = [part.masses() for part in self.parts.values()]
        lanes = torch.broadcast_shapes(*(p.mass.shape[:-1] for p in points), *(p.rotary.shape[:-1] for p in points))
        mass, rotary = (
            torch.cat([getattr(p, name).expand(*lanes, -1) for p in points], dim=-1) for name in ("mass", "rotary")
        )
        return MassPoints(self._ends, mass, rotary)

    def mass(self) -> Float[Tensor, "*lanes N"] | SparseMatrix:
        """M of the free freedoms: its diagonal where all masses are lumped at free nodes, else a sparse matrix."""
        _, mass, rotary = self.masses()
        per_freedom = torch.stack([mass] * 3 + [rotary] * 3, dim=-1)  # [..., points, 6]
        if self.diagonal:
            full = mass.new_zeros(*mass.shape[:-1], len(self.mesh.nodes), 6)
            return full.index_add(-2, self._ends[:, 0], per_freedom).flatten(-2)[..., self.freedoms.free]
        corners = (per_freedom[..., None, :] / 4.0).expand(*per_freedom.shape[:-1], 4, 6).flatten(-3)
        values = mass.new_zeros(*mass.shape[:-1], self._mass_size).index_add(-1, self._mass_entry, corners)
        small = mass.new_zeros(*mass.shape[:-1], self.mass_pattern.nnz)
        small = small.index_add(-1, self._mass_slot, values[..., self._mass_source] * self._mass_factor)
        return SparseMatrix(self.mass_pattern, small)

    def at_points(self, field: Float[Tensor, "*lanes n *rest"], axis: int) -> Tensor:
        """Take a nodal field to the mass points, along `axis` (negative)."""
        one = field.index_select(axis, self._ends[:, 0])
        return one if self._lumped else 0.5 * (one + field.index_select(axis, self._ends[:, 1]))
