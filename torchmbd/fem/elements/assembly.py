"""Stiffness and mass of a flexible body: parts on common nodes, and the free degrees of freedom of these nodes.

    K(b) = sum_parts values_p(b)        on the free degrees of freedom, one sparsity pattern
    M(b) = sum of mass points: at nodes (lumped; diagonal where they need no arms) or halfway between two nodes

A part has a pattern over all degrees of freedom 6 * node + i of the mesh, computed once, and values for the present design. A
new kind of element is one class with the methods of `Part`.

Mass points: mass m and isotropic rotary inertia mu at a node, eq. (2), or at the middle of two nodes, which moves with
their mean; or at the end of a rigid arm on them. With three such points at the middles of its sides a triangle has its
consistent mass, exact for linear shape functions; with four on arms in its plane a beam's section has any inertia; an
arm along its normal takes a laminate's mass off its middle surface, by the first moment of its density.
Differentiable, forward and reverse, in the parameters of the parts, with lanes.
Checked in tests/fem/elements/test_assembly.py, tests/fem/elements/test_beams.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.fem.elements.freedoms import Freedoms, MeanMotion, ReducedEntries
from torchmbd.fem.elements.geometric import StressedCells, assembled_geometric_stiffness
from torchmbd.fem.elements.links import Follower
from torchmbd.fem.elements.part import ExpandingPart, LosingPart, MassPoints, Part
from torchmbd.math.rigid_motion import hat
from torchmbd.math.sparse import Pattern, SparseMatrix


class Meshed(Protocol):
    """A mesh as an assembly uses it."""

    @property
    def nodes(self) -> Float[Tensor, "n 3"]: ...


class Assembly:
    """Parts on the nodes of one mesh; some nodes may be held or linked.

    mesh    its nodes have the degrees of freedom
    parts   name -> part
    held    nodes that are fixed
    links   nodes that follow others
    means   mean motions that are degrees of freedom of their own
    """

    def __init__(
        self,
        mesh: Meshed,
        parts: Mapping[str, Part],
        held: Sequence[int] = (),
        links: Sequence[Follower] = (),
        means: Sequence[MeanMotion] = (),
    ) -> None:
        self.mesh, self.parts = mesh, dict(parts)
        self.freedoms = Freedoms(mesh.nodes, held, links, means=means)
        points = [part.masses() for part in self.parts.values()]
        entries = self._reduced_entries()
        absent = self._absent(points, entries)
        if len(absent):
            self.freedoms = Freedoms(mesh.nodes, held, links, absent, means)
            entries = self._reduced_entries()
        self._ends = torch.cat([p.ends for p in points])
        self._lumped = bool((self._ends[:, 0] == self._ends[:, 1]).all())
        self._prepare_stiffness(entries)
        arms = any(p.arm is not None for p in points)
        self.diagonal = self._lumped and self.freedoms.plain and not arms
        self._entries = torch.arange(36) if arms else 7 * torch.arange(6)  # of a point's 6 x 6 inertia
        if not self.diagonal:
            self._prepare_mass()

    def _reduced_entries(self) -> list[ReducedEntries]:
        """Entries of K of each part at the free degrees of freedom."""
        return [self.freedoms.reduced(part.pattern) for part in self.parts.values()]

    def _absent(self, points: Sequence[MassPoints], entries: Sequence[ReducedEntries]) -> Int[Tensor, " k"]:
        """Return free degrees of freedom without stiffness, such as rotations of solids; warn of those with mass."""
        used = torch.zeros(len(self.freedoms.free), dtype=torch.bool)
        for part in entries:
            used |= part.pattern.start.diff() > 0
        if bool(used.all()):
            return torch.zeros(0, dtype=torch.long)
        full = torch.zeros(6 * len(self.mesh.nodes), dtype=torch.bool)
        for p in (p for p in points if len(p.ends)):
            heavy, turning = (x.detach().reshape(-1, x.shape[-1]).amax(0) > 0 for x in (p.mass, p.rotary))
            turning = turning if p.arm is None else heavy | turning
            for has, first in ((heavy, 0), (turning, 3)):
                full[(6 * p.ends[has].flatten()[:, None] + torch.arange(first, first + 3)).flatten()] = True
        heavy = torch.zeros_like(used)
        heavy[self.freedoms.cols[full[self.freedoms.rows]]] = True
        still = self.freedoms.free[heavy & ~used]
        if len(still):
            node, i = divmod(int(still[0]), 6)
            named = getattr(self.mesh, "node_name", lambda k: f"node {k}")(node)
            what = f"{'along' if i < 3 else 'about'} {'xyz'[i % 3]}"
            warn(
                f"{named} has mass but no stiffness {what} ({len(still)} such degrees of freedom): it does "
                "not move relative to the body frame"
            )
        return self.freedoms.free[~used]

    def _prepare_stiffness(self, entries: list[ReducedEntries]) -> None:
        """Find the entries of each part in the common pattern of the free degrees of freedom."""
        if len(entries) == 1:
            self.pattern, self._entries_of_parts = entries[0].pattern, entries
            return
        rows, cols = (torch.cat([getattr(part.pattern, name) for part in entries]) for name in ("rows", "cols"))
        self.pattern, position = Pattern.gather(rows, cols, len(self.freedoms.free))
        places = position.split([part.pattern.nnz for part in entries])
        self._entries_of_parts = [part.at(place, self.pattern) for part, place in zip(entries, places, strict=True)]

    def _prepare_mass(self) -> None:
        """Find the entries of M for each mass point: a quarter of its inertia for each two ends of its node pair."""
        i, j = torch.div(self._entries, 6, rounding_mode="floor"), self._entries % 6
        ends = self._ends
        pairs = torch.stack([ends[:, [0, 0, 1, 1]], ends[:, [0, 1, 0, 1]]], dim=-1)  # [points, 4, 2]
        rows, cols = (6 * pairs[..., k, None] + local for k, local in ((0, i), (1, j)))  # [points, 4, entries]
        pattern, entry = Pattern.gather(rows.flatten(), cols.flatten(), 6 * len(self.mesh.nodes))
        self._reduced_mass = self.freedoms.reduced(pattern)
        self.mass_pattern = self._reduced_mass.pattern
        # M values = sum over (point, corner, entry) with the weight 1/4, then through T.
        self._mass_entry, self._mass_size = entry, pattern.nnz

    def stiffness(self) -> SparseMatrix:
        """K of the free degrees of freedom."""
        return self._joined([part.values(entries.source) for part, entries in self._sources])

    def loss_stiffness(self) -> SparseMatrix | None:
        """Derivative of K where the moduli of each ply grow by its loss factor; None without loss factors."""
        if not any(isinstance(part, LosingPart) and part.loses for part in self.parts.values()):
            return None
        values = []
        for part, entries in self._sources:
            if isinstance(part, LosingPart) and part.loses:
                values.append(part.loss_values(entries.source))
            else:
                values.append(torch.zeros(len(entries.source), dtype=torch.float64))
        return self._joined(values)

    def stressed(
        self, motion: Float[Tensor, "*lanes n 6 k"], changes: Mapping[str, str] | None = None
    ) -> list[StressedCells]:
        """Cells of all parts under the stress of k motions of all nodes (geometric.py).

        changes   part -> kind of change (part.py): the stress of its free strains by a unit change is subtracted
        """
        return [cells for name in self.parts for cells in self._stressed_part(name, motion, changes or {})]

    def geometric(
        self, motion: Float[Tensor, "*lanes n 6 k"], changes: Mapping[str, str] | None = None
    ) -> SparseMatrix:
        """Geometric stiffness of the free degrees of freedom, stressed by k motions of all nodes, lanes [*lanes, k]; changes
        as in `stressed`."""
        k = motion.shape[-1]
        values = []
        for (part, entries), name in zip(self._sources, self.parts, strict=True):
            cells = self._stressed_part(name, motion, changes or {})
            whole = (
                assembled_geometric_stiffness(part.pattern, cells) if cells else motion.new_zeros(k, part.pattern.nnz)
            )
            values.append(whole[..., entries.source])
        return self._joined(values)

    def _stressed_part(self, name: str, motion: Tensor, changes: Mapping[str, str]) -> list[StressedCells]:
        part = self.parts[name]
        if name not in changes:
            return part.stressed(motion)
        assert isinstance(part, ExpandingPart)
        return part.stressed(motion, changes[name])

    @property
    def _sources(self) -> list[tuple[Part, ReducedEntries]]:
        return list(zip(self.parts.values(), self._entries_of_parts, strict=True))

    def _joined(self, values: list[Tensor]) -> SparseMatrix:
        """Return the matrix of the free degrees of freedom from the values of all parts."""
        first, *others = (part.values(v) for part, v in zip(self._entries_of_parts, values, strict=True))
        return SparseMatrix(self.pattern, sum(others, first), symmetric=True)

    def masses(self) -> MassPoints:
        """All mass points."""
        points = [part.masses() for part in self.parts.values()]
        lanes = np.broadcast_shapes(*(p.mass.shape[:-1] for p in points), *(p.rotary.shape[:-1] for p in points))
        mass, rotary = (
            torch.cat([getattr(p, name).expand(*lanes, -1) for p in points], dim=-1) for name in ("mass", "rotary")
        )
        if all(p.arm is None for p in points):
            return MassPoints(self._ends, mass, rotary)
        none = self.mesh.nodes.new_zeros(1, 3)
        arms = [(none if p.arm is None else p.arm).expand(*lanes, len(p.ends), 3) for p in points]
        return MassPoints(self._ends, mass, rotary, torch.cat(arms, dim=-2))

    def mass(self, points: MassPoints | None = None) -> Float[Tensor, "*lanes N"] | SparseMatrix:
        """M of the free degrees of freedom: its diagonal where all masses are lumped at free nodes, else a sparse matrix.

        points: the result of `masses`, if it is known
        """
        _, mass, rotary, arm = self.masses() if points is None else points
        inertia = _inertia(mass, rotary, arm)  # [..., points, entries]
        if self.diagonal:
            full = mass.new_zeros(*mass.shape[:-1], len(self.mesh.nodes), 6)
            return full.index_add(-2, self._ends[:, 0], inertia).flatten(-2)[..., self.freedoms.free]
        corners = (inertia[..., None, :] / 4.0).expand(*inertia.shape[:-1], 4, -1).flatten(-3)
        values = mass.new_zeros(*mass.shape[:-1], self._mass_size).index_add(-1, self._mass_entry, corners)
        return SparseMatrix(self.mass_pattern, self._reduced_mass.values(values[..., self._reduced_mass.source]))

    def mass_positions(self, x: Float[Tensor, "n 3"], arm: Tensor | None) -> Float[Tensor, "*lanes points 3"]:
        """Positions of the mass points on these arms, from those of the nodes."""
        middles = self._middles(x, -2)
        return middles if arm is None else middles + arm

    def mass_motion(self, psi: Float[Tensor, "*lanes n 6 k"], arm: Tensor | None) -> Float[Tensor, "*lanes points 6 k"]:
        """Displacements and rotations of the mass points on these arms, from those of the nodes."""
        at = self._middles(psi, -3)
        if arm is None:
            return at
        moved, turned = at.split(3, dim=-2)
        return torch.cat([moved + torch.linalg.cross(turned, arm[..., None].expand_as(turned), dim=-2), turned], dim=-2)

    def forces_on_nodes(
        self, forces: Float[Tensor, "*lanes points 6 k"], arm: Tensor | None
    ) -> Float[Tensor, "*lanes n 6 k"]:
        """Forces and moments on the nodes of those on the mass points on these arms: the transpose of `mass_motion`."""
        if arm is not None:
            force, moment = forces.split(3, dim=-2)
            moment = moment + torch.linalg.cross(arm[..., None].expand_as(force), force, dim=-2)
            forces = torch.cat([force, moment], dim=-2)
        none = forces.new_zeros(*forces.shape[:-3], len(self.mesh.nodes), *forces.shape[-2:])
        if self._lumped:
            return none.index_add(-3, self._ends[:, 0], forces)
        return none.index_add(-3, self._ends[:, 0], 0.5 * forces).index_add(-3, self._ends[:, 1], 0.5 * forces)

    def _middles(self, field: Tensor, axis: int) -> Tensor:
        start = field.index_select(axis, self._ends[:, 0])
        return start if self._lumped else 0.5 * (start + field.index_select(axis, self._ends[:, 1]))


def _inertia(mass: Tensor, rotary: Tensor, arm: Tensor | None) -> Float[Tensor, "*lanes points entries"]:
    """Inertia of mass points about their nodes: the diagonals of 6 x 6 matrices, or with arms the whole of them."""
    if arm is None:
        return torch.stack([mass] * 3 + [rotary] * 3, dim=-1)
    lever = hat(arm)
    eye = torch.eye(3, dtype=arm.dtype).expand_as(lever)
    at_node = torch.cat([torch.cat([eye, -lever], dim=-1), torch.cat([lever, lever.mT @ lever], dim=-1)], dim=-2)
    turning = torch.diag(arm.new_tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
    return (mass[..., None, None] * at_node + rotary[..., None, None] * turning).flatten(-2)
