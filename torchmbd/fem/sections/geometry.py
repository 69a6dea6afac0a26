"""What a section's mesh contributes to its analysis: strains of warping, in wall axes, at the points of all elements.

    eps = P Z psi + B u + P H u'

psi   generalized strains of the section (eps, gamma_y, gamma_z, kappa_x, kappa_y, kappa_z)
u     warping at the nodes (u_x, u_y, u_z), u' its derivative along the beam
Z     displacement gradient along x of a rigid section: (eps + z kappa_y - y kappa_z, gamma_y - z kappa_x,
      gamma_z + y kappa_x), in wall axes
B     strains of warping in the section's plane;  H its interpolation;  P puts (x, s, n) into eps_xx, gamma_xs, gamma_xn

Strains (xx, ss, nn, sn, xn, xs). All that is here is constant: the design enters by the layers' stiffness D only,
because strains are expressed in the axes in which plies are laid. Fields are [..., m, g, 6, columns].
Source: V. Giavotto et al., Anisotropic beam theory and applications, Computers & Structures 16 (1983) 403-413,
doi:10.1016/0045-7949(83)90179-7.
Checked in tests/fem/sections/test_section_laws.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.fem.sections.mesh import SectionMesh
from torchmbd.fem.sections.shapes import rule, shape

AXIAL = [0, 5, 4]  # eps_xx, gamma_xs, gamma_xn: what acts on the face x = const


class SectionGeometry:
    """Constants of a mesh; see the module header. Elements of different kinds are padded to one size."""

    dofs: Int[Tensor, "m 3k"]
    weight: Float[Tensor, "m g"]

    def __init__(self, mesh: SectionMesh) -> None:
        self.nodes, self.layer = len(mesh.nodes), mesh.layer
        connectivity, weight, N, slopes, along = _padded(mesh)
        self.connectivity, self.weight = connectivity, weight
        self.dofs = (3 * connectivity[..., None] + torch.arange(3)).flatten(1)
        yz = torch.einsum("mgk,mki->mgi", N, mesh.nodes[connectivity])
        self.points = yz
        if mesh.plane_angle is not None:
            along = torch.stack([torch.cos(mesh.plane_angle), torch.sin(mesh.plane_angle)], dim=-1)[:, None]
            along = along.expand_as(yz)
        self.turn = _turn(along)
        self.H = (N[..., None, :, None] * self.turn[..., None, :]).flatten(-2).flatten(1, 2)
        self.B = _warping_strains(slopes @ self.turn[..., 1:, 1:].mT, self.turn).flatten(1, 2)
        self.Z = self.turn @ _rigid(yz)

    def warp_strain(self, u: Float[Tensor, "*lanes freedoms c"]) -> Tensor:
        """B u."""
        return self._per_point(self.B @ u[..., self.dofs, :], 6)

    def carried(self, du: Float[Tensor, "*lanes freedoms c"]) -> Tensor:
        """P H u'."""
        return _place(self._per_point(self.H @ du[..., self.dofs, :], 3))

    def rigid_strain(self, psi: Float[Tensor, "*lanes 6 c"]) -> Tensor:
        """P Z psi."""
        return _place(self.Z @ psi[..., None, None, :, :])

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

    def element_stiffness(self, D: Float[Tensor, "layers 6 6"]) -> Float[Tensor, "m 3k 3k"]:
        """Integral of B' D B."""
        B = self.B.unflatten(1, (-1, 6))
        DB = (self.weight[..., None, None] * (D[self.layer, None] @ B)).flatten(1, 2)
        return self.B.mT @ DB

    def layer_pairs(self, left: Tensor, right: Tensor, layers: int) -> Float[Tensor, "*lanes layers 6 6"]:
        """Integral of left right' (strain fields), element sums gathered by layer: a cotangent of D."""
        element = (self.weight[..., None, None] * left).transpose(-3, -2).flatten(-2)
        element = element @ right.transpose(-3, -2).flatten(-2).mT
        result = element.new_zeros(*element.shape[:-3], layers, 6, 6)
        return result.index_add(-3, self.layer, element)

    def members(self, layers: int) -> list[Tensor]:
        """Indices of the elements of each layer."""
        return [(self.layer == k).nonzero()[:, 0] for k in range(layers)]

    def _per_point(self, flat: Tensor, rows: int) -> Tensor:
        return flat.unflatten(-2, (-1, rows))

    def _assembled(self, element: Tensor) -> Tensor:
        result = element.new_zeros(*element.shape[:-3], 3 * self.nodes, element.shape[-1])
        return result.index_add(-2, self.dofs.flatten(), element.flatten(-3, -2))


def _padded(mesh: SectionMesh) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Nodes [m, k], weights [m, g], shape functions [m, g, k], their slopes in (y, z) [m, g, k, 2], side 12 [m, g, 2]."""
    rules = [rule(block.shape[1]) for block in mesh.elements]
    m, k, g = sum(map(len, mesh.elements)), max(b.shape[1] for b in mesh.elements), max(len(w) for _, w in rules)
    connectivity = torch.zeros(m, k, dtype=torch.long)
    weight = mesh.nodes.new_zeros(m, g)
    N, slopes = mesh.nodes.new_zeros(m, g, k), mesh.nodes.new_zeros(m, g, k, 2)
    along = mesh.nodes.new_zeros(m, g, 2)
    along[..., 0] = 1.0
    start = 0
    for block, (points, w) in zip(mesh.elements, rules, strict=True):
        own, size, count = slice(start, start + len(block)), block.shape[1], len(w)
        values, natural = shape(size, points)
        jacobian = torch.einsum("gki,mkj->mgij", natural, mesh.nodes[block])
        connectivity[own, :size] = block
        weight[own, :count] = w * torch.linalg.det(jacobian)
        N[own, :count, :size] = values
        slopes[own, :count, :size] = natural @ torch.linalg.inv(jacobian).mT
        along[own, :count] = jacobian[..., 0, :] / jacobian[..., 0, :].norm(dim=-1, keepdim=True)
        start += len(block)
    return connectivity, weight, N, slopes, along


def _turn(along: Tensor) -> Float[Tensor, "m g 3 3"]:
    """Displacements (x, y, z) -> (x, s, n)."""
    c, s = along.unbind(-1)
    turn = along.new_zeros(*along.shape[:2], 3, 3)
    turn[..., 0, 0] = 1.0
    turn[..., 1, 1], turn[..., 1, 2], turn[..., 2, 1], turn[..., 2, 2] = c, s, -s, c
    return turn


def _rigid(yz: Tensor) -> Float[Tensor, "m g 3 6"]:
    Z = yz.new_zeros(*yz.shape[:2], 3, 6)
    Z[..., [0, 1, 2], [0, 1, 2]] = 1.0
    Z[..., 0, 4], Z[..., 0, 5] = yz[..., 1], -yz[..., 0]
    Z[..., 1, 3], Z[..., 2, 3] = -yz[..., 1], yz[..., 0]
    return Z


def _warping_strains(slopes: Tensor, turn: Tensor) -> Float[Tensor, "m g 6 3k"]:
    """From slopes in wall axes (s, n) [m, g, k, 2] and the turn of displacements."""
    ds, dn = slopes[..., 0], slopes[..., 1]
    x, s, n = (turn[..., None, i, :] for i in range(3))
    rows = [
        torch.zeros_like(ds[..., None] * x),
        ds[..., None] * s,
        dn[..., None] * n,
        dn[..., None] * s + ds[..., None] * n,
        dn[..., None] * x,
        ds[..., None] * x,
    ]
    return torch.stack(rows, dim=2).flatten(-2)


def _place(face: Tensor) -> Tensor:
    """(x, s, n) [..., 3, c] -> rows xx, xs, xn of strains [..., 6, c]."""
    zero = torch.zeros_like(face[..., 0, :])
    return torch.stack([face[..., 0, :], zero, zero, zero, face[..., 2, :], face[..., 1, :]], dim=-2)
