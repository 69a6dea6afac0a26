"""PlateMatrices: the basis gives what a plain assembly gives, for any laminate, lane and tangent; lumped mass."""

import pytest
import torch
from torch.func import functional_call, jacrev, jvp, vmap
from torch.testing import assert_close

from tests.fem.elements.plate_cases import CARBON, GENERAL, irregular, rotation, turned
from tests.refused import refused
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.elements.facet import facets
from torchmbd.fem.elements.triangle import triangle_strains
from torchmbd.fem.materials import IsotropicMean, Laminate
from torchmbd.fem.mesh import rectangle

MESH = turned(irregular(0.5, 0.3, (3, 2)), rotation(7))
ALONG = (1.0, 0.3, -0.2)
PLATE = PlateMatrices(MESH, GENERAL, ALONG)


def assembled(laminate):
    """Sum of area / 3 E' C E over points and triangles with the whole 8 x 8 law, one triangle after the other."""
    s = laminate.stiffness()
    C = torch.block_diag(torch.cat([torch.cat([s.A, s.B], 1), torch.cat([s.B, s.D], 1)], 0), s.As).detach()
    plane = facets(MESH, ALONG)
    K = torch.zeros(6 * len(MESH.nodes), 6 * len(MESH.nodes), dtype=torch.float64)
    for E, area, nodes in zip(
        triangle_strains(plane, IsotropicMean.of(laminate)).at, plane.area, MESH.triangles, strict=True
    ):
        rows = (6 * nodes[:, None] + torch.arange(6)).flatten()
        K[rows[:, None], rows] += area / 3 * (E.mT @ C @ E).sum(0)
    return K


@pytest.mark.parametrize("angles", [(20, -50, 75), (0, 90, 0), (-81, 33, 12)])
def test_basis_is_the_assembly(angles):
    laminate = Laminate(CARBON, torch.deg2rad(torch.tensor(angles).double()), GENERAL.thickness.detach())
    K = PLATE.stiffness(laminate.entries().detach()).dense()
    assert_close(K, assembled(laminate), rtol=1e-12, atol=1e-14 * float(K.abs().max()))
    assert_close(K, K.T, rtol=0, atol=1e-15 * float(K.abs().max()))


def test_pattern_couples_nodes_that_share_a_triangle():
    near = torch.zeros(len(MESH.nodes), len(MESH.nodes), dtype=torch.bool)
    for nodes in MESH.triangles:
        near[nodes[:, None], nodes] = True
    blocks = torch.zeros_like(near)
    blocks[PLATE.pattern.rows // 6, PLATE.pattern.cols // 6] = True
    assert torch.equal(near, blocks)
    assert PLATE.pattern.nnz == 36 * int(near.sum())


@pytest.mark.usefixtures("products")
def test_several_rows_at_once():
    angles = torch.tensor([[0.1, 0.2, -0.3], [1.0, -1.2, 0.4]], dtype=torch.float64, requires_grad=True)
    K = PLATE.values(functional_call(GENERAL, {"angles": angles}, ()))
    rows = torch.randn(3, *K.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    result = vmap(lambda row: torch.autograd.grad(K, angles, row, retain_graph=True)[0])(rows)
    for row, own in zip(rows, result, strict=True):
        assert_close(own, torch.autograd.grad(K, angles, row, retain_graph=True)[0])


@pytest.mark.usefixtures("products")
def test_lanes_and_tangents():
    angles = torch.tensor([[0.1, 0.2, -0.3], [1.0, -1.2, 0.4]], dtype=torch.float64)

    def values(theta):
        return PLATE.stiffness(functional_call(GENERAL, {"angles": theta}, ())).values

    both = values(angles)
    assert_close(both[1], values(angles[1]), rtol=1e-12, atol=1e-12 * float(both.abs().max()))
    eye = torch.eye(3, dtype=torch.float64)
    forward = vmap(lambda e: jvp(values, (angles[0],), (e,))[1])(eye).T
    weights = torch.linspace(-1, 1, PLATE.pattern.nnz, dtype=torch.float64)
    reverse = jacrev(lambda a: weights @ values(a))(angles[0])
    assert_close(weights @ forward, reverse, rtol=1e-10, atol=1e-10 * float(reverse.abs().max()))
    for k in range(3):
        difference = (values(angles[0] + 1e-5 * eye[k]) - values(angles[0] - 1e-5 * eye[k])) / 2e-5
        assert_close(forward[:, k], difference, rtol=1e-7, atol=1e-8 * float(forward.abs().max()))


def test_mass_is_shared_by_area_and_stays_whole():
    mesh = rectangle(3.0, 2.0, (3, 2))
    plate = PlateMatrices(mesh, GENERAL)
    assert plate.area.sum().item() == pytest.approx(6.0, rel=1e-14)
    assert plate.area[mesh.node("corner_left_bottom")].item() == pytest.approx(1 / 4)  # a square of 1 m2
    mass = plate.lumped_mass(torch.tensor([7.0, 8.0]).double(), torch.tensor([0.1, 0.2]).double())
    assert mass.shape == (2, 72)
    by_freedom = mass.reshape(2, 12, 6).sum(1)
    expected = 6.0 * torch.tensor([[7, 7, 7, 0.1, 0.1, 0.1], [8, 8, 8, 0.2, 0.2, 0.2]]).double()
    assert_close(by_freedom, expected)


def test_number_of_entries_is_checked():
    with refused("entries"):
        PLATE.stiffness(torch.ones(2, 20, dtype=torch.float64))
