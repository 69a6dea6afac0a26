"""OPT membrane: rigid motion, rank, and in-plane bending as Felippa designed it."""

import pytest
import torch
from torch.testing import assert_close

from torchmbd.fem.elements.facet import facets
from torchmbd.fem.elements.opt_membrane import beta0, membrane_strains
from torchmbd.fem.mesh import Mesh, rectangle

TRIANGLE = torch.tensor([[[0.1, -0.3], [1.4, 0.2], [0.3, 0.9]]], dtype=torch.float64)


def area(corners):
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def stiffness(corners, C, poisson):
    E = membrane_strains(corners, area(corners), poisson)
    return torch.einsum("m,mpai,ab,mpbj->mij", area(corners) / 3, E, C, E)


def plane_stress(nu):
    return torch.tensor([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]], dtype=torch.float64) / (1 - nu**2)


def test_rank_is_six():
    values = torch.linalg.eigvalsh(stiffness(TRIANGLE, plane_stress(0.3), 0.3)[0])
    assert (abs(values[:3]) < 1e-14).all()
    assert (values[3:] > 1e-3).all()


@pytest.mark.parametrize("field", ["translation", "rotation", "strain"])
def test_linear_fields_have_their_own_strain(field):
    """A rigid rotation turns the corners too; a pure strain does not."""
    gradient = {"translation": [[0, 0], [0, 0]], "rotation": [[0, -1], [1, 0]], "strain": [[0.3, 0.2], [0.2, -0.7]]}
    G = torch.tensor(gradient[field], dtype=torch.float64)
    spin = torch.full((3, 1), float(G[1, 0] - G[0, 1]) / 2, dtype=torch.float64)
    u = torch.cat([TRIANGLE[0] @ G.T + 0.4, spin], dim=1).flatten()
    strain = membrane_strains(TRIANGLE, area(TRIANGLE), 0.3)[0] @ u
    expected = torch.stack([G[0, 0], G[1, 1], G[0, 1] + G[1, 0]])
    assert_close(strain, expected.expand(3, 3), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("nu", [0.0, 0.2, 0.3])
@pytest.mark.parametrize("cells", [1, 2, 16])
@pytest.mark.parametrize("leaning", [True, False])
def test_in_plane_bending_energy_is_exact(nu, cells, leaning):
    """Two triangles per cell, cells from square to 16 : 1, both ways of drawing the diagonals: Felippa's design aim."""
    mesh = rectangle(16.0, 1.0, (cells, 1), "triangle")
    if leaning:
        a = 2 * torch.arange(cells)[:, None]
        mesh = Mesh(mesh.nodes, torch.cat([a + torch.tensor([0, 2, 3]), a + torch.tensor([0, 3, 1])]))
    plane = facets(mesh)
    x, y = mesh.nodes[:, 0], mesh.nodes[:, 1]
    u = torch.stack([x * y, -(x**2) / 2 - nu * y**2 / 2, -x], dim=1)  # curvature 1, free to contract
    E = membrane_strains(plane.corners, plane.area, nu)
    strain = (E @ u[mesh.triangles].flatten(1)[:, None, :, None]).squeeze(-1)
    energy = torch.einsum("m,mpa,ab,mpb->", plane.area / 6, strain, plane_stress(nu), strain)
    assert energy.item() == pytest.approx(16.0 / 12 / 2, rel=1e-12)


def test_weight_stays_positive():
    assert beta0(0.0) == 0.5
    assert beta0(0.5) == 0.01
