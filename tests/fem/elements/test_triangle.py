"""DKMT bending: rigid motion, rank, its two limits (DKT of Batoz; assumed shear), and a strip of Timoshenko beam.

OPT membrane: rigid motion, rank, and in-plane bending as Felippa designed it.
"""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.fem.elements.plate_cases import freedoms, mapped, solved, stiffness
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.elements.facet import facets
from torchmbd.fem.elements.triangle import beta0, membrane_strains, plate_strains
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import Mesh, rectangle

TRIANGLE = torch.tensor([[[0.1, -0.3], [1.4, 0.2], [0.3, 0.9]]], dtype=torch.float64)
AREA = torch.tensor([0.73], dtype=torch.float64)
THIN, THICK = 1e-7, 1e7


def corner_values(w, beta_x, beta_y):
    x, y = TRIANGLE[0].T
    zero = torch.zeros(3, dtype=torch.float64)
    return torch.stack([w(x, y) + zero, beta_x(x, y) + zero, beta_y(x, y) + zero], dim=1).flatten()


@pytest.mark.parametrize("shear_length", [THIN, 0.3, THICK])
def test_constant_curvature_is_exact_without_shear(shear_length):
    u = corner_values(
        lambda x, y: -(0.3 * x**2 + 0.5 * y**2 + 0.7 * x * y) / 2,
        lambda x, y: 0.3 * x + 0.35 * y,
        lambda x, y: 0.5 * y + 0.35 * x,
    )
    kappa, gamma = plate_strains(TRIANGLE, AREA, shear_length)
    expected = torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64)
    assert_close(kappa[0] @ u, expected.expand(3, 3), rtol=1e-13, atol=1e-13)
    assert (abs(gamma[0] @ u) < 1e-14).all()


def test_rigid_motion_is_free_and_rank_is_six():
    kappa, gamma = plate_strains(TRIANGLE, AREA, 0.3)
    rigid = corner_values(lambda x, y: 0.3 + 0.2 * x - 0.5 * y, lambda x, y: -0.2, lambda x, y: 0.5)
    assert (abs(kappa[0] @ rigid) < 1e-14).all()
    assert (abs(gamma[0] @ rigid) < 1e-14).all()
    E = torch.cat([kappa, gamma], dim=2)[0].flatten(0, 1)
    singular = torch.linalg.svdvals(E)
    assert singular[5] > 1e-2
    assert singular[6] < 1e-14


def test_thick_limit_has_the_assumed_shear_and_linear_rotations():
    """A constant shear strain with the rotations held is exact there: no curvature, no other shear."""
    u = corner_values(lambda x, y: 0.4 * x - 0.9 * y, lambda x, y: 0.0, lambda x, y: 0.0)
    kappa, gamma = plate_strains(TRIANGLE, AREA, THICK)
    assert_close(gamma[0] @ u, torch.tensor([0.4, -0.9], dtype=torch.float64).expand(3, 2), rtol=1e-12, atol=1e-12)
    assert (abs(kappa[0] @ u) < 1e-12).all()


def batoz_dkt(corners, xi, eta):
    """Curvature matrix of DKT from its printed shape functions, freedoms w, theta_x = w,y, theta_y = -w,x.

    Source: J.-L. Batoz, K.-J. Bathe, L.-W. Ho, A study of three-node triangular plate bending elements, Int. J. Numer.
    Methods Eng. 15 (1980) 1771-1812, eqs. (30)-(35).
    """
    x, y = corners.T
    pairs = {4: (1, 2), 5: (2, 0), 6: (0, 1)}
    P, q, t, r = {}, {}, {}, {}
    for k, (i, j) in pairs.items():
        xij, yij = x[i] - x[j], y[i] - y[j]
        l2 = xij**2 + yij**2
        P[k], t[k], q[k], r[k] = -6 * xij / l2, -6 * yij / l2, 3 * xij * yij / l2, 3 * yij**2 / l2
    Hx_xi = [
        P[6] * (1 - 2 * xi) + (P[5] - P[6]) * eta,
        q[6] * (1 - 2 * xi) - (q[5] + q[6]) * eta,
        -4 + 6 * (xi + eta) + r[6] * (1 - 2 * xi) - eta * (r[5] + r[6]),
        -P[6] * (1 - 2 * xi) + eta * (P[4] + P[6]),
        q[6] * (1 - 2 * xi) - eta * (q[6] - q[4]),
        -2 + 6 * xi + r[6] * (1 - 2 * xi) + eta * (r[4] - r[6]),
        -eta * (P[5] + P[4]),
        eta * (q[4] - q[5]),
        -eta * (r[5] - r[4]),
    ]
    Hx_eta = [
        -P[5] * (1 - 2 * eta) - xi * (P[6] - P[5]),
        q[5] * (1 - 2 * eta) - xi * (q[5] + q[6]),
        -4 + 6 * (xi + eta) + r[5] * (1 - 2 * eta) - xi * (r[5] + r[6]),
        xi * (P[4] + P[6]),
        xi * (q[4] - q[6]),
        -xi * (r[6] - r[4]),
        P[5] * (1 - 2 * eta) - xi * (P[4] + P[5]),
        q[5] * (1 - 2 * eta) + xi * (q[4] - q[5]),
        -2 + 6 * eta + r[5] * (1 - 2 * eta) + xi * (r[4] - r[5]),
    ]
    Hy_xi = [
        t[6] * (1 - 2 * xi) + eta * (t[5] - t[6]),
        1 + r[6] * (1 - 2 * xi) - eta * (r[5] + r[6]),
        -q[6] * (1 - 2 * xi) + eta * (q[5] + q[6]),
        -t[6] * (1 - 2 * xi) + eta * (t[4] + t[6]),
        -1 + r[6] * (1 - 2 * xi) + eta * (r[4] - r[6]),
        -q[6] * (1 - 2 * xi) - eta * (q[4] - q[6]),
        -eta * (t[4] + t[5]),
        eta * (r[4] - r[5]),
        -eta * (q[4] - q[5]),
    ]
    Hy_eta = [
        -t[5] * (1 - 2 * eta) - xi * (t[6] - t[5]),
        1 + r[5] * (1 - 2 * eta) - xi * (r[5] + r[6]),
        -q[5] * (1 - 2 * eta) + xi * (q[5] + q[6]),
        xi * (t[4] + t[6]),
        xi * (r[4] - r[6]),
        -xi * (q[4] - q[6]),
        t[5] * (1 - 2 * eta) - xi * (t[4] + t[5]),
        -1 + r[5] * (1 - 2 * eta) + xi * (r[4] - r[5]),
        -q[5] * (1 - 2 * eta) - xi * (q[4] - q[5]),
    ]
    x31, y31, x12, y12 = x[2] - x[0], y[2] - y[0], x[0] - x[1], y[0] - y[1]
    twice = x31 * y12 - x12 * y31
    Hx_xi, Hx_eta, Hy_xi, Hy_eta = (np.array(h) for h in (Hx_xi, Hx_eta, Hy_xi, Hy_eta))
    return np.stack([
        y31 * Hx_xi + y12 * Hx_eta,
        -x31 * Hy_xi - x12 * Hy_eta,
        -x31 * Hx_xi - x12 * Hx_eta + y31 * Hy_xi + y12 * Hy_eta,
    ]) / twice  # fmt: skip


def test_thin_limit_is_the_discrete_kirchhoff_triangle():
    kappa, gamma = plate_strains(TRIANGLE, AREA, THIN)
    # Batoz: beta_x = -w,x = theta_y and beta_y = -w,y = -theta_x.
    turn = np.kron(np.eye(3), np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
    for point, (xi, eta) in enumerate([(0.5, 0.0), (0.5, 0.5), (0.0, 0.5)]):
        expected = batoz_dkt(TRIANGLE[0].numpy(), xi, eta)
        np.testing.assert_allclose(kappa[0, point].numpy() @ turn, expected, rtol=1e-10, atol=1e-10)
    assert (abs(gamma) < 1e-12).all()


@pytest.mark.parametrize("height", [0.01, 0.5, 2.0])
def test_strip_under_a_tip_load_is_a_timoshenko_beam(height):
    """Bending moment linear, shear constant: the state in which DKMT shares out its gaps. nu = 0, ten cells."""
    L, b, E = 10.0, 1.0, 1e7
    laminate = Laminate(Ply.isotropic(E, 0.0, 1.0), [0.0], height)
    mesh = mapped((10, 1), lambda s, t: (L * s, b * (t - 0.5), 0.0))
    plate = PlateMatrices(mesh, laminate)
    load = np.zeros(6 * len(mesh.nodes))
    tip = mesh.node_set("right_edge")
    load[freedoms(tip, [2])] = 0.5
    held = np.union1d(freedoms(mesh.node_set("left_edge")), freedoms(range(len(mesh.nodes)), [0, 1, 3, 5]))
    w = solved(stiffness(plate, laminate), load, held)[freedoms(tip, [2])]
    exact = L**3 / (3 * E * b * height**3 / 12) + L / (5 / 6 * E / 2 * b * height)
    assert w == pytest.approx(exact, rel=4e-3)


def area(corners):
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def membrane_stiffness(corners, C, poisson):
    E = membrane_strains(corners, area(corners), poisson)
    return torch.einsum("m,mpai,ab,mpbj->mij", area(corners) / 3, E, C, E)


def plane_stress(nu):
    return torch.tensor([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]], dtype=torch.float64) / (1 - nu**2)


def test_rank_of_the_membrane_is_six():
    values = torch.linalg.eigvalsh(membrane_stiffness(TRIANGLE, plane_stress(0.3), 0.3)[0])
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
