"""The quadrilateral: its map, in-plane bending of slanted cells, the two limits of its shear, warped cells."""

import math

import numpy as np
import pytest
import torch
from torch.func import hessian, jacfwd
from torch.testing import assert_close

from tests.fem.elements.plate_cases import CARBON, freedoms, mapped, solved, stiffness
from tests.refused import refused
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.elements.quad_bending import plate_strains
from torchmbd.fem.elements.quad_membrane import membrane
from torchmbd.fem.elements.quad_shape import gauss
from torchmbd.fem.materials import IsotropicMean, Laminate, Ply
from torchmbd.fem.mesh import Mesh
from torchmbd.math.angles import deg

GENERAL = torch.tensor([[[0.1, -0.3], [1.4, 0.2], [1.0, 1.1], [0.2, 0.8]]], dtype=torch.float64)
CELL = torch.full((1, 4), 0.9, dtype=torch.float64)
EDGES = torch.tensor([[True, True, False, True]])


def bent(long, lean, laminate):
    """Turn of the end of a strip under an end moment; one row of six cells, width 1, each `long` x as long."""
    n = 6

    def place(s, t):
        k = round(s * n)
        shift = 0.0 if k in (0, n) else lean[k % 2] * (t - 0.5)
        return long * n * s + shift, t, 0.0

    mesh = mapped((n, 1), place, "quad")
    load = np.zeros(6 * len(mesh.nodes))
    load[6 * mesh.node("corner_right_top")], load[6 * mesh.node("corner_right_bottom")] = -1.0, 1.0
    held = [freedoms(mesh.node_set("left_edge"), [0]), freedoms([mesh.node("corner_left_bottom")], [1])]
    plane = freedoms(range(len(mesh.nodes)), [2, 3, 4])
    u = solved(stiffness(PlateMatrices(mesh, laminate), laminate), load, np.unique(np.concatenate([*held, plane])))
    return load @ u


def test_the_rule_knows_area_and_center():
    points = gauss(GENERAL)
    x, y = GENERAL[0].T
    cross = x * y.roll(-1) - x.roll(-1) * y
    area = cross.sum() / 2
    center = torch.stack([((x + x.roll(-1)) * cross).sum(), ((y + y.roll(-1)) * cross).sum()]) / (6 * area)
    assert_close(points.weight.sum(), area)
    assert_close((points.weight[..., None] * points.position).sum((0, 1)) / area, center)
    slope = torch.tensor([0.3, -0.7], dtype=torch.float64)
    assert_close(points.slopes @ (GENERAL @ slope)[:, None, :, None], slope.expand(1, 4, 2)[..., None])


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize(
    ("long", "lean", "error"),
    [
        (0.2, (0.0, 0.0), 1e-8),
        (1.0, (0.0, 0.0), 1e-8),
        (9.0, (0.0, 0.0), 1e-8),
        (5.0, (1.0, 1.0), 1e-3),  # MacNeal and Harder's parallelograms of 45 degrees
        (5.0, (1.0, -1.0), 1e-3),  # and trapezoids
        (1.0, (-0.7, -0.7), 1e-3),
        (1.0, (0.4, -0.4), 2e-3),
    ],
)
def test_a_strip_of_one_row_bends_as_a_beam(nu, long, lean, error):
    """Exactly with rectangles: all cells have the beam's stresses, which are in equilibrium at every node."""
    laminate = Laminate(Ply.isotropic(1.0, nu, 1.0), [0.0], 1.0)
    assert bent(long, lean, laminate) == pytest.approx(12 * 6 * long, rel=error)


@pytest.mark.parametrize("angle", [0, 30, 45, 90, -70])
@pytest.mark.parametrize(("long", "lean", "error"), [(0.3, (0, 0), 1e-8), (4.0, (0, 0), 1e-8), (2.0, (0.5, 0.5), 0.02)])
def test_a_strip_of_one_angle_bends_as_a_beam(angle, long, lean, error):
    """Its width contracts and its fibers pull it askew as they like, which no isotropic strain field allows."""
    laminate = Laminate(CARBON, deg([angle]), 0.1)
    compliance = float(torch.linalg.inv(laminate.stiffness().A.detach())[0, 0])
    assert bent(long, lean, laminate) == pytest.approx(12 * compliance * 6 * long, rel=error)


def test_membrane_rank_is_nine():
    flat = membrane(
        GENERAL, gauss(GENERAL), 0.3, torch.zeros(1, dtype=torch.float64), torch.ones(1, 4, dtype=torch.bool)
    )
    values = torch.linalg.svdvals(torch.cat([flat.mean[0], flat.drill[0].flatten(0, 1), flat.forces.work[0]]))
    assert values[8] > 1e-3 * values[0]
    assert values[9] < 1e-14


def corner_values(w, beta_x, beta_y):
    x, y = GENERAL[0].T
    zero = torch.zeros(4, dtype=torch.float64)
    return torch.stack([w(x, y) + zero, beta_x(x, y) + zero, beta_y(x, y) + zero], dim=1).flatten()


@pytest.mark.parametrize("shear_length", [1e-7, 0.3, 1e7])
def test_constant_curvature_is_exact_without_shear(shear_length):
    u = corner_values(
        lambda x, y: -(0.3 * x**2 + 0.5 * y**2 + 0.7 * x * y) / 2,
        lambda x, y: 0.3 * x + 0.35 * y,
        lambda x, y: 0.5 * y + 0.35 * x,
    )
    kappa, gamma = plate_strains(GENERAL, gauss(GENERAL), IsotropicMean(0.3, shear_length), CELL, EDGES)
    assert_close(kappa[0] @ u, torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64).expand(4, 3), rtol=1e-12, atol=1e-12)
    assert (abs(gamma[0] @ u) < 1e-14).all()


def test_thick_limit_is_the_assumed_shear_with_bilinear_rotations():
    """A constant shear strain with the rotations held is exact there: no curvature, no other shear."""
    u = corner_values(lambda x, y: 0.4 * x - 0.9 * y, lambda x, y: 0.0, lambda x, y: 0.0)
    kappa, gamma = plate_strains(GENERAL, gauss(GENERAL), IsotropicMean(0.3, 1e7), CELL, EDGES)
    assert_close(gamma[0] @ u, torch.tensor([0.4, -0.9], dtype=torch.float64).expand(4, 2), rtol=1e-12, atol=1e-12)
    assert (abs(kappa[0] @ u) < 1e-12).all()


def test_thin_limit_is_the_discrete_kirchhoff_quadrilateral():
    """A cubic deflection along x of a rectangle: no shear, and its curvature with the weight of a long cell."""
    corners = torch.tensor([[[-0.5, -0.2], [0.5, -0.2], [0.5, 0.2], [-0.5, 0.2]]], dtype=torch.float64)
    x = corners[0, :, 0]
    u = torch.stack([x**3, -3 * x**2, 0 * x], dim=1).flatten()  # beta = -w,x: kappa_xx = -6 x
    points = gauss(corners)
    kappa, gamma = plate_strains(corners, points, IsotropicMean(0.3, 1e-7), CELL, EDGES)
    assert (abs(gamma[0] @ u) < 1e-12).all()
    assert_close(kappa[0, :, 0] @ u, -6 * 1.6**0.5 * points.position[0, :, 0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("width", [0.1, 1.0, 7.0])
def test_thin_rectangles_know_the_whole_twist_of_a_cubic(width):
    """w = x^2 y: all three curvatures at every point, half of the twist not from beta_x but from its symmetry."""
    corners = torch.tensor([[[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]], dtype=torch.float64)
    corners = corners * torch.tensor([1.0, width], dtype=torch.float64)
    x, y = corners[0].T
    u = torch.stack([x**2 * y, -2 * x * y, -(x**2)], dim=1).flatten()
    points = gauss(corners)
    kappa, gamma = plate_strains(corners, points, IsotropicMean(0.3, 1e-7), CELL, EDGES)
    at = points.position[0]
    assert (abs(gamma[0] @ u) < 1e-12).all()
    exact = torch.stack([-2 * at[:, 1], 0 * at[:, 0], -4 * at[:, 0]], dim=1)
    assert_close(kappa[0] @ u, exact, rtol=1e-9, atol=1e-10)


def test_thin_slanted_cells_know_the_curvature_of_all_cubics():
    """w = xi^3, xi^2 eta and so on in a rhombus of 40 degrees, whose quadratic parts count once, but for 1 %."""
    a, b = torch.tensor([0.5, 0.0]).double(), 0.5 * torch.tensor([math.cos(0.7), math.sin(0.7)]).double()
    corners = torch.stack([-a - b, a - b, a + b, b - a])[None]
    inverse = torch.linalg.inv(torch.stack([a, b], dim=1))  # natural coordinates of a place

    def w(x, power):
        xi, eta = inverse @ x
        return xi**power * eta ** (3 - power)

    points = gauss(corners)
    for power in range(4):
        slope, second = jacfwd(lambda x, k=power: w(x, k)), hessian(lambda x, k=power: w(x, k))
        u = torch.stack([torch.cat([w(x, power)[None], -slope(x)]) for x in corners[0]]).flatten()
        kappa, gamma = plate_strains(corners, points, IsotropicMean(0.3, 1e-7), CELL, EDGES)
        exact = torch.stack([-torch.stack([h[0, 0], h[1, 1], 2 * h[0, 1]]) for h in map(second, points.position[0])])
        assert (abs(gamma[0] @ u) < 1e-11).all()
        assert_close(kappa[0] @ u, exact, rtol=0, atol=0.02 * float(exact.abs().max()))


@pytest.mark.parametrize(("thickness", "down", "across"), [(0.32, 0.005424, 0.001754), (0.0032, 5256.0, 1294.0)])
def test_a_twisted_strip_of_one_row_of_warped_cells(thickness, down, across):
    """Twisted by 90 degrees over 12 cells, each warped by 7.5 degrees: MacNeal and Harder's beam, thick and thin."""
    laminate = Laminate(Ply.isotropic(29e6, 0.22, 1.0), [0.0], thickness)

    def place(s, t):
        return 12 * s, 1.1 * (t - 0.5) * math.cos(math.pi / 2 * s), 1.1 * (t - 0.5) * math.sin(math.pi / 2 * s)

    mesh = mapped((12, 1), place, "quad")
    tip = mesh.node_set("right_edge")
    K = stiffness(PlateMatrices(mesh, laminate), laminate)
    for way, reference in ((2, down), (1, across)):
        load = np.zeros(6 * len(mesh.nodes))
        load[freedoms(tip, [way])] = 0.5
        u = solved(K, load, freedoms(mesh.node_set("left_edge")))
        assert u[freedoms(tip, [way])].mean() == pytest.approx(reference, rel=0.01)


def rough(refined, kind):
    """End deflection of a thin strip of 10 x 2 bilinear patches, their corners off its plane by +-h, under an end moment."""
    h = 2e-3
    laminate = Laminate(Ply.isotropic(70e9, 0.0, 1.0), [0.0], h)

    def wave(x):
        return 1 - 2 * abs(x % 2 - 1)

    mesh = mapped(
        (10 * refined, 2 * refined), lambda s, t: (s, 0.2 * t, h * wave(round(10 * s, 9)) * wave(round(2 * t, 9))), kind
    )
    end = mesh.node_set("right_edge")
    share = np.ones(len(end))
    share[[0, -1]] = 0.5
    load = np.zeros(6 * len(mesh.nodes))
    load[freedoms(end, [4])] = share / share.sum()
    u = solved(stiffness(PlateMatrices(mesh, laminate), laminate), load, freedoms(mesh.node_set("left_edge")))
    return u[6 * mesh.node("right") + 2]


@pytest.mark.thorough
def test_bilinear_patches_bend_as_fine_triangles_say():
    """No patch is flat. Two cells across each are within 1 %; one, warped to and fro, keeps 0.95 of it."""
    fine = rough(8, "triangle")
    assert rough(2, "quad") == pytest.approx(fine, rel=0.01)
    assert rough(4, "quad") == pytest.approx(fine, rel=0.01)
    assert rough(1, "quad") == pytest.approx(fine, rel=0.05)


def test_a_collapsed_neighbor_is_refused_at_the_mesh():
    nodes = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.2, 0.2, 0], [0, 1, 0]])
    with refused("cells.0", [0, 1, 2, 3]):
        Mesh(nodes, quads=[[0, 1, 2, 3]])
