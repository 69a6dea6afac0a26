"""Cross-section analysis of a laminated beam: 6 x 6 stiffness and mass, centers, stresses, from 2-D finite elements.

    (N, V_y, V_z, T, M_y, M_z) = K (eps, gamma_y, gamma_z, kappa_x, kappa_y, kappa_z)

x along the beam, y and z in the section; forces and moments about the origin of the section's axes. The warping u(y, z)
of the section is free in all three directions. A force F and moment M that vary along the beam as equilibrium demands
(M' = -e_x cross F) make stress and warping linear in x, without any assumption on either: Saint-Venant's solutions.

    1  extension, torsion, bending (psi of four, no shear):   E u + R psi = 0
    2  shear, at the place where the moment vanishes:         E u = (C' - C) u' + L psi' ,   (u', psi') from 1
       (C' - C) u' + L psi' = H' sigma(1) - B' D P H u'

Each gives six fields of strain for unit forces; S_ij = integral of eps_i' D eps_j is the section's compliance, K = S^-1.
The shear strains gamma are those that make this energy 1/2 V gamma.

Differentiable, forward and reverse, in angles and numbers of the plies (saint_venant.py) and in the dimensions of the mesh
(geometry.py), which may carry leading lanes.
Assumed: prismatic beam, linear elasticity, forces applied at the ends (distributed forces act on the beam only).
Source: V. Giavotto, M. Borri, P. Mantegazza et al., Anisotropic beam theory and applications, Computers & Structures
16 (1983) 403-413, doi:10.1016/0045-7949(83)90179-7; J. P. Blasques, User's Manual for BECAS, Risoe-R-1785 (2012).
Checked in tests/fem/sections/test_section_*.py, tests/validation/test_sections_*.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.materials.expansion import coefficients
from torchmbd.fem.materials.laminate_checks import checked_angles
from torchmbd.fem.materials.ply import Lamina
from torchmbd.fem.sections.geometry import SectionGeometry
from torchmbd.fem.sections.mesh import SectionMesh
from torchmbd.fem.sections.orthotropic import Orthotropic, in_wall_axes, strain_rotation
from torchmbd.fem.sections.saint_venant import UnitFields, compliance, held_stress, unit_fields
from torchmbd.fem.sections.warping import WarpingProblem
from torchmbd.math.checked_numbers import differentiable_reals
from torchmbd.math.inverse import balanced_inverse
from torchmbd.math.variable import LayerNumbers, stacked, without_variables

#: The order of forces, moments and generalized strains.
FORCES = ("N", "V_y", "V_z", "T", "M_y", "M_z")


class SectionStress(NamedTuple):
    """Strains and stresses [Pa] in ply axes (11, 22, 33, 23, 13, 12) at points [m, g, 2] of all elements."""

    strain: Float[Tensor, "*lanes m g 6"]
    stress: Float[Tensor, "*lanes m g 6"]
    points: Float[Tensor, "m g 2"]


class SectionExpansion(NamedTuple):
    """A free section after a change of temperature or moisture.

    strain   (eps, gamma_y, gamma_z, kappa_x, kappa_y, kappa_z)
    stress   in ply axes (11, 22, 33, 23, 13, 12) at the points of all elements, without resultants [Pa]
    """

    strain: Float[Tensor, "*lanes 6"]
    stress: Float[Tensor, "*lanes m g 6"]


class Section(nn.Module):
    """A meshed section; `.angles` [rad] is its parameter, one value for each layer that the mesh names.

    mesh     elements with their layers and wall angles; dimensions of it that vary are parameters: "width", "thickness"
    ply      one Ply or Orthotropic, or one for each layer; numbers of it that vary are parameters, as for a Laminate
    angles   of the fiber about the wall's normal, from x to the wall's tangent [layers], rad

    The functions of `mbd.sections` make it: tube, box, strip, circle, rectangle, and profiles such as
    i_section and c_section.
    """

    #: Parameters that are positive in any design.
    positive: ClassVar[tuple[str, ...]] = ("width", "height", "radius", "crown", "thickness")
    #: Parameter -> how far an entry of it may turn until every number of the section is the same again [rad].
    periods: ClassVar[Mapping[str, float]] = {"angles": math.pi}
    angles: Tensor
    _constant: Tensor

    def __init__(
        self,
        mesh: SectionMesh,
        ply: Lamina | Orthotropic | Sequence[Lamina | Orthotropic],
        angles: Sequence[float] | Tensor = (0.0,),
    ) -> None:
        super().__init__()
        theta = checked_angles("Section", angles)
        plies = [ply] * len(theta) if isinstance(ply, Lamina | Orthotropic) else list(ply)
        if len(plies) != len(theta):
            raise InputError(
                "ply",
                allowed="must have one ply, or one per angle",
                state=f"has {len(plies)} plies for {len(theta)} angles",
                noun="Section",
            )
        if mesh.layers > len(theta):
            raise InputError(
                "angles",
                allowed="must have one layer for each angle",
                state=f"has {mesh.layers} layers, but there are {len(theta)} angles",
                noun="Section: the mesh",
            )
        self._plies = LayerNumbers(self, "ply", plies)
        self._solids = [Orthotropic.of(without_variables(p)) for p in plies]
        self.mesh = mesh
        self.problem = WarpingProblem(SectionGeometry(mesh), mesh.nodes)
        for name, (x, _) in mesh.dimensions.items():
            self.register_parameter(name, x)
        self.angles = theta
        self.register_buffer("_constant", _constants_of(self._solids), persistent=False)

    @property
    def plies(self) -> list[Orthotropic]:
        """The solid of every layer, with the numbers of the present design."""
        return [solid.of_design(ply) for solid, ply in zip(self._solids, self._plies.current(self), strict=True)]

    @property
    def mass_varies(self) -> bool:
        """True if the mass depends on the design."""
        return self._plies.vary or bool(self.mesh.dimensions)

    @property
    def geometry(self) -> SectionGeometry:
        """Mesh of the present design."""
        return self.problem.geometry.with_dimensions(self._dimensions)

    @property
    def nodes(self) -> Float[Tensor, "*lanes n 2"]:
        """Nodes of the mesh in the present design [m]."""
        return self.problem.geometry.node_positions(self._dimensions)

    @property
    def _dimensions(self) -> Float[Tensor, "*lanes e"]:
        """Dimensions of the mesh that are parameters [m]."""
        dimensions = [(getattr(self, name), x.dim()) for name, (x, _) in self.mesh.dimensions.items()]
        flat = [x.reshape(*x.shape[: x.dim() - rank], -1) for x, rank in dimensions]
        lanes = np.broadcast_shapes(*(x.shape[:-1] for x in flat))
        return torch.cat([self._constant.new_zeros(*lanes, 0), *(x.expand(*lanes, -1) for x in flat)], -1)

    @property
    def _numbers(self) -> Float[Tensor, "*lanes layers 37"]:
        return _constants_of(self.plies) if self._plies.vary else self._constant

    @property
    def _wall_stiffness(self) -> Float[Tensor, "*lanes layers 6 6"]:
        """Stiffness of the layers in wall axes (x, s, n) [Pa]."""
        return in_wall_axes(self._numbers[..., :36].unflatten(-1, (6, 6)), self.angles)

    def forward(self) -> Float[Tensor, "*lanes 6 6"]:
        """Return `stiffness()`, so that torch.func.functional_call can evaluate the section with other parameters."""
        return self.stiffness()

    def stiffness(self) -> Float[Tensor, "*lanes 6 6"]:
        """K; units N, N m, N m2."""
        return balanced_inverse(self.compliance())

    def compliance(self) -> Float[Tensor, "*lanes 6 6"]:
        """S = K^-1."""
        return compliance(self.problem, self._dimensions, self._wall_stiffness)

    def mass(self) -> Float[Tensor, "*lanes 6 6"]:
        """Inertia per length of the velocities (v, omega) of the section's axes: kg/m, kg, kg m."""
        g = self.geometry
        gradient = g.rigid
        rigid = torch.zeros_like(gradient)
        rigid[..., [0, 1, 2], [0, 1, 2]] = 1.0
        rigid[..., :, 3:] = gradient[..., :, 3:]
        weight = g.weight * self._numbers[..., -1][..., g.layer, None]
        return (weight[..., None, None] * (rigid.mT @ rigid)).sum((-4, -3))

    def shear_center(self) -> Float[Tensor, "*lanes 2"]:
        """Point y, z [m] at which a shear force does not cause twist (of the section alone: without bend-twist coupling)."""
        S = self.compliance()
        return torch.stack([-S[..., 3, 2], S[..., 3, 1]], dim=-1) / S[..., 3, 3, None]

    def tension_center(self) -> Float[Tensor, "*lanes 2"]:
        """Point y, z [m] at which a normal force does not cause curvature."""
        S = self.compliance()
        a, b, c = S[..., 4, 4], S[..., 4, 5], S[..., 5, 5]
        p, q = S[..., 4, 0], S[..., 5, 0]
        # kappa_y = p + z a - y b = 0, kappa_z = q + z b - y c = 0
        return torch.stack([a * q - b * p, b * q - c * p], dim=-1) / (a * c - b * b)[..., None]

    def stress(self, force: Sequence[float | Tensor] | Float[Tensor, "*lanes 6"]) -> SectionStress:
        """Recover strains and stresses under (N, V_y, V_z, T, M_y, M_z) [N, N m] at the points of all elements."""
        load = differentiable_reals("force", force, f"must have shape [..., 6], {', '.join(FORCES)}")
        if load.shape[-1:] != (6,):
            raise InputError(
                "force", load, f"must have shape [..., 6], {', '.join(FORCES)}", state=f"has shape {tuple(load.shape)}"
            )
        _, strain, stress = self.unit_fields()
        load = load[..., None, None, :, None]
        g = self.geometry
        T = strain_rotation(self.angles)[..., g.layer, None, :, :]
        back = self._to_plies()[..., g.layer, None, :, :]
        return SectionStress((T @ strain @ load)[..., 0], (back @ stress @ load)[..., 0], g.points)

    def free_strain(self, change: str) -> Float[Tensor, "*lanes 6"]:
        """Strains of the free section by a unit change: by Betti, <stress of unit forces, free strain>.

        The shear strains are conjugate to the shear forces. In an unsymmetric strip they differ from the shear strains of
        lamination theory: a shear force causes moments of the plies, which do work on the free curvature across the strip.
        """
        return self.geometry.energy(self.unit_fields().stress, self._free_strains(change))[..., 0]

    def expansion(self, change: str) -> SectionExpansion:
        """Return strains and residual stresses of the free section by a unit change (`CHANGES` of elements/part.py).

        Gradients of the temperature are along the y- and the z-axis of the section. Raises InputError that names a layer
        without a coefficient.
        """
        g = self.geometry
        held = held_stress(self.problem, g, self._wall_stiffness, self._free_strains(change))
        stress = held - self.unit_fields().stress @ g.resultant(held)[..., None, None, :, :]
        back = self._to_plies()[..., g.layer, None, :, :]
        return SectionExpansion(self.free_strain(change), (back @ stress)[..., 0])

    def _free_strains(self, change: str) -> Float[Tensor, "*lanes m g 6 1"]:
        """Free strains of all points in wall axes; across the fiber they are equal in all directions."""
        kind = "moisture" if change == "moisture" else "temperature"
        along, across, _ = coefficients(self._plies.current(self), kind, "section").unbind(-1)
        none = torch.zeros_like(along)
        plies = torch.stack([along, across, across, none, none, none], -1)[..., None]
        walls = (strain_rotation(-self.angles) @ plies)[..., self.geometry.layer, None, :, :]
        y, z = self.geometry.points[..., None, None].unbind(-3)
        return walls * {"gradient": z, "gradient_y": y}.get(change, torch.ones_like(y))

    @cached_property
    def stress_points(self) -> Int[Tensor, "points 2"]:
        """Element and integration point in it of every point of `unit_stress`."""
        return (self.problem.geometry.weight > 0).nonzero()

    def unit_stress(self) -> Float[Tensor, "*lanes points 6 6"]:
        """Stresses [Pa] in ply axes (11, 22, 33, 23, 13, 12) at the `stress_points`; last axis: the six unit forces."""
        element, point = self.stress_points.unbind(1)
        to_plies = self._to_plies()[..., self.problem.geometry.layer[element], :, :]
        return to_plies @ self.unit_fields().stress[..., element, point, :, :]

    def unit_fields(self) -> UnitFields:
        """Strains and stresses in wall axes for unit forces (saint_venant.py)."""
        return unit_fields(self.problem, self.geometry, self._wall_stiffness)

    def _to_plies(self) -> Float[Tensor, "*lanes layers 6 6"]:
        """Return the map from stresses in wall axes to ply axes: T^-T, where T^-1 rotates by the opposite angle."""
        return strain_rotation(-self.angles).mT


def _constants_of(solids: Sequence[Orthotropic]) -> Float[Tensor, "*lanes layers 37"]:
    """Stiffness (36 numbers) and density of every layer."""
    rows = [(solid.stiffness().flatten(-2), stacked([solid.density])) for solid in solids]
    lanes = np.broadcast_shapes(*(x.shape[:-1] for row in rows for x in row))
    return torch.stack([torch.cat([x.expand(*lanes, -1) for x in row], -1) for row in rows], -2)
