"""Strains of a section's mesh by warping and rigid motion, in wall axes, at the integration points of all elements.

    eps = P Z psi + B u + P H u'

psi   generalized strains of the section (eps, gamma_y, gamma_z, kappa_x, kappa_y, kappa_z)
u     warping at the nodes (u_x, u_y, u_z), u' its derivative along the beam
Z     displacement gradient along x of a rigid section: (eps + z kappa_y - y kappa_z, gamma_y - z kappa_x,
      gamma_z + y kappa_x), in wall axes
B     strains of warping in the section's plane;  H its interpolation;  P puts (x, s, n) into eps_xx, gamma_xs, gamma_xn

Strains (xx, ss, nn, sn, xn, xs), in the axes in which plies are laid: so angles and numbers of plies enter by the layers'
stiffness D only, and the fields here depend on the positions of the nodes alone (`with_dimensions`): [..., m, g, 6, columns].
Differentiable, forward and reverse, in the nodes, which may carry leading lanes.
Source: V. Giavotto et al., Anisotropic beam theory and applications, Computers & Structures 16 (1983) 403-413,
doi:10.1016/0045-7949(83)90179-7.
Checked in tests/fem/sections/test_section_laws.py.
"""

from __future__ import annotations

import copy
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchmbd.errors import InputError
from torchmbd.fem.sections.mesh import SectionMesh
from torchmbd.fem.sections.shapes import rule, shape
from torchmbd.math.gradients import all_true

AXIAL = [0, 5, 4]  # eps_xx, gamma_xs, gamma_xn: what acts on the face x = const


class SectionGeometry:
    """A mesh with its nodes at positions [*lanes, n, 2] (module header). Elements of all kinds are padded to one size."""

    dofs: Int[Tensor, "m 3k"]
    weight: Float[Tensor, "*lanes m g"]

    def __init__(self, mesh: SectionMesh) -> None:
        self.nodes, self.layer, self._mesh = len(mesh.nodes), mesh.layer, mesh
        most = max(block.shape[1] for block in mesh.elements)
        self.connectivity = torch.cat([pad(block, (0, most - block.shape[1])) for block in mesh.elements])
        self.dofs = (3 * self.connectivity[..., None] + torch.arange(3)).flatten(1)
        none = mesh.nodes.new_zeros(0, *mesh.nodes.shape)
        self._units = torch.cat([none, *(units for _, units in mesh.dimensions.values())])
        sizes = [x.detach().flatten() for x, _ in mesh.dimensions.values()]
        self._rest = mesh.nodes - torch.einsum("e,eni->ni", torch.cat([mesh.nodes.new_zeros(0), *sizes]), self._units)
        self._set_nodes(mesh.nodes)

    def with_dimensions(self, x: Float[Tensor, "*lanes e"]) -> SectionGeometry:
        """Return the same mesh with dimensions x, in the order of `mesh.dimensions`.

        Raises InputError if that turns an element inside out.
        """
        if not x.shape[-1]:
            return self
        result = copy.copy(self)
        for name in ("rotation", "H", "B", "Z"):
            vars(result).pop(name, None)
        result._set_nodes(self.node_positions(x))
        if not all_true((result.weight >= 0.0).flatten()):
            raise InputError(
                "dimensions",
                allowed="must have walls that fit into the section",
                state="turn an element inside out",
                noun="dimensions of a section",
            )
        return result

    def node_positions(self, x: Float[Tensor, "*lanes e"]) -> Float[Tensor, "*lanes n 2"]:
        """Return the positions of the nodes for dimensions x [m]."""
        return self._rest + torch.einsum("...e,eni->...ni", x, self._units)

    def _set_nodes(self, nodes: Float[Tensor, "*lanes n 2"]) -> None:
        self.weight, N, self._slopes, self._along = _padded(self._mesh, nodes, self.connectivity.shape[1])
        self.points = torch.einsum("mgk,...mki->...mgi", N, nodes[..., self.connectivity, :])
        self._N = N

    @cached_property
    def rotation(self) -> Float[Tensor, "*lanes m g 3 3"]:
        """Rotation of displacements (x, y, z) to wall axes (x, s, n)."""
        if self._mesh.plane_angle is None:
            return _wall_rotation(self._along)
        plane = torch.stack([torch.cos(self._mesh.plane_angle), torch.sin(self._mesh.plane_angle)], dim=-1)[:, None]
        return _wall_rotation(plane.expand(*self.points.shape[-3:]))

    @cached_property
    def H(self) -> Float[Tensor, "*lanes m 3g 3k"]:
        return (self._N[..., None, :, None] * self.rotation[..., None, :]).flatten(-2).flatten(-3, -2)

    @cached_property
    def B(self) -> Float[Tensor, "*lanes m 6g 3k"]:
        ds, dn = (self._slopes @ self.rotation[..., 1:, 1:].mT)[..., None, :].unbind(-1)  # slopes along s and n
        x, s, n = (self.rotation[..., None, i, :] for i in range(3))
        rows = [torch.zeros_like(ds * x), ds * s, dn * n, dn * s + ds * n, dn * x, ds * x]
        return torch.stack(rows, dim=-3).flatten(-2).flatten(-3, -2)

    @cached_property
    def Z(self) -> Float[Tensor, "*lanes m g 3 6"]:
        return self.rotation @ self.rigid

    @property
    def rigid(self) -> Float[Tensor, "*lanes m g 3 6"]:
        """Displacement gradient along x of a rigid section, in section axes."""
        y, z = self.points.unbind(-1)
        o = torch.zeros_like(y)
        unit = o + 1.0
        rows = [unit, o, o, o, z, -y, o, unit, o, -z, o, o, o, o, unit, y, o, o]
        return torch.stack(rows, -1).unflatten(-1, (3, 6))

    @property
    def field_size(self) -> int:
        """Number of entries of the largest field of one design."""
        return self.dofs.numel() * self.weight.shape[-1] * 6

    def warp_strain(self, u: Float[Tensor, "*lanes freedoms c"]) -> Tensor:
        """B u."""
        return (self.B @ u[..., self.dofs, :]).unflatten(-2, (-1, 6))

    def warping_rate_strain(self, du: Float[Tensor, "*lanes freedoms c"]) -> Tensor:
        """P H u', strains of warping that varies along the beam."""
        return _face_strains((self.H @ du[..., self.dofs, :]).unflatten(-2, (-1, 3)))

    def rigid_strain(self, psi: Float[Tensor, "*lanes 6 c"]) -> Tensor:
        """P Z psi."""
        return _face_strains(self.Z @ psi[..., None, None, :, :])

    def stress(self, D: Float[Tensor, "*lanes layers 6 6"], strain: Tensor) -> Tensor:
        """D eps."""
        return D[..., self.layer, None, :, :] @ strain

    def warp_force(self, stress: Tensor) -> Float[Tensor, "*lanes freedoms c"]:
        """Integral of B' sigma."""
        return self._assembled(self.B.mT @ (self.weight[..., None, None] * stress).flatten(-3, -2))

    def face_force(self, stress: Tensor) -> Float[Tensor, "*lanes freedoms c"]:
        """Integral of H' P' sigma: the nodal forces of the stress on the face x = const."""
        face = self.weight[..., None, None] * stress[..., AXIAL, :]
        return self._assembled(self.H.mT @ face.flatten(-3, -2))

    def resultant(self, stress: Tensor) -> Float[Tensor, "*lanes 6 c"]:
        """Integral of Z' P' sigma: the section's force and moment (N, V_y, V_z, T, M_y, M_z)."""
        return (self.Z.mT @ (self.weight[..., None, None] * stress[..., AXIAL, :])).sum((-4, -3))

    def energy(self, strain: Tensor, stress: Tensor) -> Float[Tensor, "*lanes c c"]:
        """Integral of eps' sigma over all pairs of columns."""
        columns = (self.weight[..., None, None] * strain).flatten(-4, -2)
        return columns.mT @ stress.flatten(-4, -2)

    def element_stiffness(self, D: Float[Tensor, "*lanes layers 6 6"]) -> Float[Tensor, "*lanes m 3k 3k"]:
        """Integral of B' D B."""
        B = self.B.unflatten(-2, (-1, 6))
        DB = (self.weight[..., None, None] * (D[..., self.layer, None, :, :] @ B)).flatten(-3, -2)
        return self.B.mT @ DB

    def element_force(self, E: Float[Tensor, "*lanes m 3k 3k"], u: Float[Tensor, "*lanes freedoms c"]) -> Tensor:
        """E u of the elements' stiffness, at the nodes [*lanes, freedoms, c]."""
        return self._assembled(E @ u[..., self.dofs, :])

    def _assembled(self, element: Tensor) -> Tensor:
        result = element.new_zeros(*element.shape[:-3], 3 * self.nodes, element.shape[-1])
        return result.index_add(-2, self.dofs.flatten(), element.flatten(-3, -2))


def _padded(mesh: SectionMesh, nodes: Tensor, most: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights [..., m, g], shape functions [m, g, k], their slopes in (y, z) [..., m, g, k, 2], side 12 [..., m, g, 2]."""
    rules = [rule(block.shape[1]) for block in mesh.elements]
    points_most = max(len(w) for _, w in rules)
    weights, N, slopes, along = [], [], [], []
    for block, (points, w) in zip(mesh.elements, rules, strict=True):
        size, rest = block.shape[1], points_most - len(w)
        values, natural = shape(size, points)
        jacobian = torch.einsum("gki,...mkj->...mgij", natural, nodes[..., block, :])
        weights.append(pad(w * torch.linalg.det(jacobian), (0, rest)))
        N.append(pad(values, (0, most - size, 0, rest)).expand(len(block), -1, -1))
        slopes.append(pad(natural @ torch.linalg.inv(jacobian).mT, (0, 0, 0, most - size, 0, rest)))
        first = jacobian[..., 0, :]
        unit = first / first.norm(dim=-1, keepdim=True)
        along.append(torch.cat([unit, unit[..., :1, :].expand(*unit.shape[:-2], rest, 2)], -2))
    return torch.cat(weights, -2), torch.cat(N), torch.cat(slopes, -4), torch.cat(along, -3)


def _wall_rotation(along: Tensor) -> Float[Tensor, "*lanes m g 3 3"]:
    """Displacements (x, y, z) -> (x, s, n)."""
    c, s = along.unbind(-1)
    o = torch.zeros_like(c)
    return torch.stack([o + 1.0, o, o, o, c, s, o, -s, c], -1).unflatten(-1, (3, 3))


def _face_strains(face: Tensor) -> Tensor:
    """(x, s, n) [..., 3, c] -> rows xx, xs, xn of strains [..., 6, c]."""
    zero = torch.zeros_like(face[..., 0, :])
    return torch.stack([face[..., 0, :], zero, zero, zero, face[..., 2, :], face[..., 1, :]], dim=-2)
