"""Stiffness and lumped mass of shear-flexible beams in space with full 6 x 6 sections.

The element is made from equilibrium, not from shape functions. With f the force and moment at its end (the rest of the
structure on the element), those of the section at d before the end are C f: M += d cross F, then turned into its axes, so

    F = integral of C' S C ds                                 flexibility of the end, by Gauss's rule
    f = F^-1 (u_2 - A' u_1),   A: M += c cross F              stiffness

S        compliance of the section about the line of the nodes, at the stations of the rule
c        the chord, from the start to the end
u_1, u_2 displacements and rotations of the ends, in the axes of the chord

Exact for beams loaded at their nodes, whatever the couplings: no locking, no dependence on the number of elements; two
stations for a prismatic element, more for one that is twisted by itself or an arc (beam_curve.py; the section is that of
the straight beam: depth over radius is small). Rigid motions are exact.
Mass: half of each element's at its ends, as four particles in the plane of the section that have its mass, center and
inertia; so products of inertia and eccentric centers need no special case in the motion.
Index of a degree of freedom: 6 * node + component (u1 u2 u3 phi1 phi2 phi3), in mesh axes, SI units. Differentiable, forward
and reverse, in the sections' stiffness, with lanes.

Geometric stiffness: all six section forces on rotations, slopes and curvatures.

    second-order strains       gamma2 = -phi x u' + 1/2 phi x (phi x t),      kappa2 = -1/2 phi x phi'
    u' Kg u = 2 integral of F . gamma2 + M . kappa2

phi, u'  rotation of the section and slope of the line, of the motion inside an element under forces at its ends:
         phi = phi_1 + integral of kappa,   u' = phi x t + gamma
F, M     force and moment of the section under the stress, at the stations

They are the strains of a geometrically exact beam to the second order; so twist, shear, eccentric sections, moments and
torsion are in it, and a rigid rotation of a stressed beam does the work of its loads, exactly. Moments at the ends are those
that belong to rotation vectors (semitangential ones).
Source: the flexibility (force) method, J. S. Przemieniecki, Theory of Matrix Structural Analysis (1968), chapter 8;
W. Carnegie, J. Thomas, E. Dokumaci, Aeronaut. Q. 20 (1969), for the shear-flexible element that this one contains; J. C.
Simo, Comput. Methods Appl. Mech. Eng. 49 (1985) 55-70, expanded here to the second order.
Checked in tests/fem/elements/test_beam_*.py, tests/fem/elements/test_geometric.py, tests/validation/test_beam_*.py.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements.beam_curve import Curves
from torchmbd.fem.elements.facet import STEEPNESS
from torchmbd.fem.elements.geometric import StressedCells, corner_motions
from torchmbd.math.checked_numbers import reals
from torchmbd.math.gradients import all_true, untransformed
from torchmbd.math.inverse import balanced_inverse
from torchmbd.math.quadratic_forms import factors
from torchmbd.math.rigid_motion import hat
from torchmbd.math.sparse import Pattern, SparseMatrix


class Line(Protocol):
    """Nodes [n, 3] and two-node elements [m, 2]: a BeamLine, or the beams of a larger mesh; middles of arcs [m, 3]."""

    nodes: Tensor
    elements: Tensor
    middles: Tensor | None


class Particles(NamedTuple):
    """Point masses [kg] on rigid arms [m], carried by the middles of node pairs; a pair (k, k) is node k."""

    ends: Int[Tensor, "p 2"]
    arm: Float[Tensor, "*lanes p 3"]
    mass: Float[Tensor, "*lanes p"]


class BeamMatrices:
    """Stiffness and mass of the beam elements of a line, computed once per mesh but for the sections.

    pattern   where K is not zero
    axes      rows e_x, e_y, e_z of each element (of its chord) in mesh axes   [m, 3, 3]
    length    of each element, along its arc                    [m], m
    stations  integration points, as parts of the length from the start, and their weights    [g]

    orientation   the sections' y-axis in mesh axes, projected across each element, of an arc across its tangents: [3], or
                  one for each element of the mesh [m, 3]
    members       indices of the elements; None: all of the mesh. `elements` holds their nodes
    stations      number of integration points; two are exact for prismatic elements
    """

    def __init__(
        self,
        mesh: Line,
        orientation: Sequence[float] | Tensor = (0.0, 1.0, 0.0),
        members: Sequence[int] | Tensor | None = None,
        stations: int = 2,
    ) -> None:
        self.mesh = mesh
        self.members = torch.arange(len(mesh.elements)) if members is None else torch.as_tensor(members)
        self.elements = mesh.elements[self.members]
        self._orientation = orientation
        points, weights = (torch.from_numpy(x) / 2.0 for x in np.polynomial.legendre.leggauss(stations))
        self.stations, self.weights, self._running = 0.5 + points, weights, cumulative(stations)
        freedoms = (6 * self.elements[:, :, None] + torch.arange(6)).flatten(1)  # [m, 12]
        rows, cols = freedoms[:, :, None].expand(-1, 12, 12), freedoms[:, None, :].expand(-1, 12, 12)
        self.pattern, self._position = Pattern.gather(rows.flatten(), cols.flatten(), 6 * len(mesh.nodes))
        self._set_nodes(mesh.nodes)

    def with_nodes(self, nodes: Float[Tensor, "*lanes n 3"]) -> BeamMatrices:
        """Return the same elements with other positions of the nodes, differentiable in these."""
        result = copy.copy(self)
        result._set_nodes(nodes)
        return result

    def _set_nodes(self, nodes: Float[Tensor, "*lanes n 3"]) -> None:
        start, end = nodes[..., self.elements, :].unbind(-2)
        middles = self.mesh.middles
        self.curves = Curves.through(start, end, None if middles is None else middles[self.members])
        self.length = self.curves.length
        span = end - start
        chord = span.norm(dim=-1)
        self.axes = self._frames((span / chord[..., None])[..., None, :])[..., 0, :, :]
        none = torch.zeros_like(self.axes)
        turn = torch.cat([torch.cat([self.axes, none], -1), torch.cat([none, self.axes], -1)], -2)
        along = torch.stack([chord, torch.zeros_like(chord), torch.zeros_like(chord)], dim=-1)
        self._whole = _transport(along, torch.eye(3, dtype=torch.float64))
        self._ends = torch.cat([-self._whole.mT @ turn, turn], dim=-1)  # u_2 - A u_1 in local axes  [m, 6, 12]
        place, tangent = self.curves.at(self.stations)
        before = (end[..., None, :] - place) @ self.axes.mT  # d of the header, in the axes of the chord
        self._carry = _transport(before, self._frames(tangent) @ self.axes[..., None, :, :].mT)  # [m, g, 6, 6]

    def values(self, stiffness: Float[Tensor, "*lanes m g 6 6"]) -> Float[Tensor, "*lanes nnz"]:
        """K values on the pattern, from the section stiffness at each station (m and g may be 1 where it is the same)."""
        k = balanced_inverse(self.flexibility(balanced_inverse(stiffness)))
        element = (self._ends.mT @ k @ self._ends).flatten(-3)
        result = element.new_zeros(*element.shape[:-1], self.pattern.nnz)
        return result.index_add(-1, self._position, element)

    def stiffness(self, stiffness: Float[Tensor, "*lanes m g 6 6"]) -> SparseMatrix:
        """K of one design or of a batch."""
        return SparseMatrix(self.pattern, self.values(stiffness))

    def flexibility(self, compliance: Float[Tensor, "*lanes m g 6 6"]) -> Float[Tensor, "*lanes m 6 6"]:
        """F of the module header."""
        weight = self.length[..., None] * self.weights
        return (weight[..., None, None] * (self._carry.mT @ compliance @ self._carry)).sum(-3)

    def forces(
        self, stiffness: Float[Tensor, "*lanes m g 6 6"], motion: Float[Tensor, "*lanes n 6 k"]
    ) -> Float[Tensor, "*lanes m 2 6 k"]:
        """(N, V_y, V_z, T, M_y, M_z) at start and end of each element, in its axes there, for k motions of the nodes."""
        k = balanced_inverse(self.flexibility(balanced_inverse(stiffness)))
        return self.along(k @ (self._ends @ motion[..., self.elements, :, :].flatten(-3, -2)))

    def along(self, end: Float[Tensor, "*lanes m 6 k"]) -> Float[Tensor, "*lanes m 2 6 k"]:
        """Section forces at start and end of each element, in its axes there, out of those at its end in axes of the chord."""
        turned = self.frames(torch.tensor([0.0, 1.0], dtype=torch.float64)) @ self.axes[..., None, :, :].mT
        here = _transport(turned.new_zeros(turned.shape[:-1]), turned)
        return here @ torch.stack([self._whole @ end, end], dim=-3)

    def held_forces(
        self, stiffness: Float[Tensor, "*lanes m g 6 6"], strain: Float[Tensor, "*lanes m g 6"]
    ) -> Float[Tensor, "*lanes m 6"]:
        """Forces and moments at the end of each element, in the axes of its chord, that cause free strains at the stations."""
        weight = self.length[..., None] * self.weights
        end = (weight[..., None, None] * (self._carry.mT @ strain[..., None])).sum(-3)
        return (balanced_inverse(self.flexibility(balanced_inverse(stiffness))) @ end)[..., 0]

    def on_nodes(self, end: Float[Tensor, "*lanes m 6"]) -> Float[Tensor, "*lanes n 6"]:
        """Forces and moments on all nodes of those at the ends of the elements, as in `held_forces`."""
        corners = (self._ends.mT @ end[..., None])[..., 0].unflatten(-1, (2, 6))
        none = corners.new_zeros(*corners.shape[:-3], len(self.mesh.nodes), 6)
        return none.index_add(-2, self.elements.flatten(), corners.flatten(-3, -2))

    def stressed(
        self,
        stiffness: Float[Tensor, "*lanes m g 6 6"],
        motion: Float[Tensor, "*lanes n 6 k"],
        held: Float[Tensor, "*lanes m 6"] | None = None,
    ) -> list[StressedCells]:
        """Return the stressed cells (geometric.py) under the section forces of k motions, less those of free strains.

        stiffness   as in `values`
        held        as `held_forces` returns them
        """
        compliance = balanced_inverse(stiffness)
        k = balanced_inverse(self.flexibility(compliance))
        local = self._carry @ (k @ self._ends)[..., None, :, :]  # section forces, axes of the section
        strains = compliance @ local
        _, tangent = self.curves.at(self.stations)
        back = self._frames(tangent).mT  # to mesh axes
        (F, M), (gamma, kappa) = ((back @ x[..., :3, :], back @ x[..., 3:, :]) for x in (local, strains))
        start = torch.nn.functional.pad(torch.eye(3, dtype=kappa.dtype), (3, 6))
        run = self.length[..., None, None] * self._running  # integrals from the start to the stations
        turned = start + (run @ kappa.flatten(-2)).unflatten(-1, kappa.shape[-2:])
        slope = torch.linalg.cross(turned, tangent[..., None].expand_as(turned), dim=-2) + gamma
        rows = torch.cat([turned, slope, kappa], -2)  # [*lanes, m, g, 9, 12]
        forces = torch.cat([F, M], -2) @ corner_motions(self.elements, motion)[..., None, :, :]
        if held is not None:
            local = (self._carry @ held[..., None, :, None]).unflatten(-2, (2, 3))
            forces = forces - (back[..., None, :, :] @ local).flatten(-3, -2)
        F, M = forces.movedim(-1, -4).split(3, dim=-1)  # [*lanes, k, m, g, 3]
        weight = self.length[..., None] * self.weights
        law = _law(F, M, tangent.unsqueeze(-4)) * weight[..., None, :, :, None, None]
        return [StressedCells(self.elements, rows.unsqueeze(-2), factors(law))]

    def frames(self, t: Float[Tensor, " g"]) -> Float[Tensor, "m g 3 3"]:
        """Axes of the sections at parts t of the lengths, rows, mesh axes."""
        return self._frames(self.curves.at(t)[1])

    def _frames(self, e_x: Float[Tensor, "*lanes m g 3"]) -> Float[Tensor, "*lanes m g 3 3"]:
        d, count = reals("orientation", self._orientation), len(self.mesh.elements)
        if d.shape not in ((3,), (count, 3)) or not torch.isfinite(d).all():
            raise InputError(
                "orientation",
                d,
                "must have shape [3], or one for each element [m, 3], finite",
                state=f"has shape {tuple(d.shape)}",
            )
        d = (d if d.ndim == 1 else d[self.members][:, None]).expand_as(e_x)
        e_y = d - (d * e_x).sum(-1, keepdim=True) * e_x
        size = e_y.norm(dim=-1, keepdim=True)
        good = size > STEEPNESS * d.norm(dim=-1, keepdim=True)
        if not all_true(good):
            k = int(untransformed(good).flatten().logical_not().nonzero()[0, 0])
            element = int(self.members[k // e_x.shape[-2] % len(self.members)])
            along, across = (untransformed(x).reshape(-1, 3)[k].tolist() for x in (e_x, d.contiguous()))
            raise InputError(
                "orientation",
                allowed="a direction across the beam, to which the section's y-axis is turned",
                state=f"lies along element {element}, direction {along}",
                noun=f"orientation {across}",
            )
        e_y = e_y / size
        return torch.stack([e_x, e_y, torch.linalg.cross(e_x, e_y)], dim=-2)

    def particles(self, mass: Float[Tensor, "*lanes m places 6 6"], consistent: bool = False) -> Particles:
        """Four particles at each place of each element, from the section mass there (m and places may be 1).

        Places: both ends, half of the mass each; or consistent with linear shape functions (Simpson's rule): a sixth at
        each end, two thirds at the middle, which moves with the mean of the ends.
        """
        m = len(self.elements)
        i, j = self.elements.unbind(1)
        pairs, shares = ((i, i), (j, j)), (0.5, 0.5)
        if consistent:
            pairs, shares = (*pairs, (i, j)), (1 / 6, 1 / 6, 2 / 3)
        shape = (m, len(pairs), 4)
        ends = torch.stack([torch.stack(pair, dim=-1) for pair in pairs], dim=1)  # [m, places, 2]
        per_length, at = section_particles(mass.expand(*mass.shape[:-4], m, len(pairs), 6, 6))
        frames = self.frames(torch.tensor([0.0, 1.0, 0.5], dtype=torch.float64)[: len(pairs)])
        arm = at @ frames[..., 1:, :]
        if consistent:  # the middle of the arc, from that of the chord
            middle = self.curves.arrow[:, None, None].expand(m, 1, 4, 3)
            arm = arm + torch.cat([torch.zeros_like(middle).expand(m, 2, 4, 3), middle], 1)
        whole = per_length * self.length[..., None, None] * self.length.new_tensor(shares)[:, None]
        return Particles(ends[:, :, None].expand(*shape, 2).reshape(-1, 2), arm.flatten(-4, -2), whole.flatten(-3))


def section_particles(mass: Float[Tensor, "*n 6 6"]) -> tuple[Float[Tensor, "*n 4"], Float[Tensor, "*n 4 2"]]:
    """Four equal particles in the section's plane with its mass, center and second moments: kg/m, places (y, z) [m].

    center +- columns of L, L L' = twice the second moments about the center: a factor has derivatives where these are equal,
    as for a tube, and principal axes have none
    """
    mu = mass[..., 0, 0]
    center = torch.stack([-mass[..., 0, 5], mass[..., 0, 4]], dim=-1) / mu[..., None]
    offset = center[..., :, None] * center[..., None, :]
    yy, yz, zz = (
        mass[..., i, j] * sign / mu - offset[..., a, b]
        for i, j, sign, a, b in ((5, 5, 1.0, 0, 0), (4, 5, -1.0, 0, 1), (4, 4, 1.0, 1, 1))
    )
    polar = mass[..., 3, 3] / (mass[..., 4, 4] + mass[..., 5, 5]) - 1.0
    good = (polar.abs() <= 0.01) & (yy > 0.0) & (yy * zz > yz * yz)
    if not all_true(good):
        wrong = untransformed(good).flatten().logical_not().nonzero()[0, 0]
        matrix, middle = untransformed(mass).reshape(-1, 6, 6)[wrong], untransformed(center).reshape(-1, 2)[wrong]
        raise InputError(
            ("mass", int(wrong)),
            allowed="must have inertias of a plane section, positive about the center, with the polar one as "
            "the sum of the other two",
            state=f"has the inertias {matrix.diagonal()[3:].tolist()} kg m with its center at {middle.tolist()} m",
            noun=f"mass of section {int(wrong)}",
        )
    first = (2.0 * yy).sqrt()
    mixed = 2.0 * yz / first
    arms = torch.stack([first, mixed, torch.zeros_like(first), (2.0 * zz - mixed * mixed).sqrt()], -1).unflatten(
        -1, (2, 2)
    )
    at = center[..., None, :] + torch.cat([arms, -arms], dim=-2)
    return (mu / 4.0)[..., None].expand(*mu.shape, 4), at


def cumulative(stations: int) -> Float[Tensor, "g g"]:
    """Return the weights of integrals from 0 to each Gauss station of a function that is known at all stations."""
    legendre = np.polynomial.legendre
    x = legendre.leggauss(stations)[0]
    whole = [legendre.legval(x, legendre.legint(row, lbnd=-1)) for row in np.eye(stations)]
    return torch.from_numpy(0.5 * np.stack(whole, 1) @ np.linalg.inv(legendre.legvander(x, stations - 1)))


def _transport(d: Float[Tensor, "*n 3"], turn: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 6 6"]:
    """C of the module header: turn [F; M + d cross F]."""
    arm = hat(d)
    turn = turn.expand(arm.shape)
    return torch.cat([torch.cat([turn, torch.zeros_like(turn)], -1), torch.cat([turn @ arm, turn], -1)], -2)


def _law(F: Tensor, M: Tensor, t: Tensor) -> Float[Tensor, "*lanes k m g 9 9"]:
    """L on phi, u', kappa."""
    t, _ = torch.broadcast_tensors(t, F)
    both = F[..., :, None] * t[..., None, :]
    eye = torch.eye(3, dtype=F.dtype)
    turned = 0.5 * (both + both.mT) - (F * t).sum(-1)[..., None, None] * eye
    none, f, m = torch.zeros_like(turned), hat(F), 0.5 * hat(M)
    rows = [torch.cat(row, -1) for row in ((turned, f, m), (f.mT, none, none), (m.mT, none, none))]
    return torch.cat(rows, -2)
