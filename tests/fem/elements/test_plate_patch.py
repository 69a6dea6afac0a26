"""Patch tests in the general position: irregular mesh, turned out of plane, unbalanced unsymmetric laminate."""

import numpy as np
import pytest
import torch

from tests.fem.elements.plate_cases import (
    CARBON,
    GENERAL,
    KINDS,
    boundary,
    freedoms,
    irregular,
    mapped,
    rotation,
    solved,
    stiffness,
    turned,
)
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate
from torchmbd.math.angles import deg

#: name -> mid-surface strain, curvature
STATES = {
    "membrane": ([1e-3, -4e-4, 7e-4], [0.0, 0.0, 0.0]),
    "bending": ([0.0, 0.0, 0.0], [0.02, -0.03, 0.05]),
    "both": ([1e-3, -4e-4, 7e-4], [0.02, -0.03, 0.05]),
}


def field(xyz, eps, kappa):
    """Displacements and rotations of a constant state in the plate's own axes [n, 6]."""
    x, y, zero = xyz[:, 0], xyz[:, 1], 0.0 * xyz[:, 0]
    w = -(kappa[0] * x**2 + kappa[1] * y**2 + kappa[2] * x * y) / 2
    w_x, w_y = -(kappa[0] * x + kappa[2] * y / 2), -(kappa[1] * y + kappa[2] * x / 2)
    return np.stack([eps[0] * x + eps[2] / 2 * y, eps[1] * y + eps[2] / 2 * x, w, w_y, -w_x, zero], axis=1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("thickness", [4.5e-3, 0.1])
def test_constant_state_is_exact_inside_and_in_energy(state, thickness, kind):
    eps, kappa = (np.array(v) for v in STATES[state])
    laminate = Laminate(CARBON, deg([20, -50, 75]), thickness / 4.5e-3 * GENERAL.thickness.detach())
    flat = irregular(0.5, 0.3, (4, 4), kind=kind)
    R = rotation(5)
    mesh = turned(flat, R)
    plate = PlateMatrices(mesh, laminate, direction=R[:, 0])
    K = stiffness(plate, laminate)
    exact = (field(flat.nodes.numpy(), eps, kappa).reshape(-1, 2, 3) @ R.T.numpy()).ravel()
    held = freedoms(boundary(mesh))
    u = solved(K, np.zeros(len(exact)), held, exact)
    scale = abs(exact).max()
    assert abs(u - exact).max() < 1e-10 * scale
    C = laminate.stiffness()
    A, B, D = (x.detach().numpy() for x in (C.A, C.B, C.D))
    energy = 0.15 / 2 * (eps @ A @ eps + 2 * eps @ B @ kappa + kappa @ D @ kappa)
    assert u @ K @ u / 2 == pytest.approx(energy, rel=1e-10)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("degrees", [[30], [-30], [30, -30], [45, 45, -20]])
def test_bending_moment_twists_an_unbalanced_strip_as_the_inverse_law_says(degrees, kind):
    """End moments M_xx = 1 N m/m alone; the whole strip has one curvature, of known sign and size."""
    laminate = Laminate(CARBON, deg(degrees), 4.5e-3 / len(degrees))
    C = laminate.stiffness()
    law = torch.cat([torch.cat([C.A, C.B], 1), torch.cat([C.B, C.D], 1)], 0).detach()
    state = torch.linalg.inv(law)[:, 3].numpy()
    eps, kappa = state[:3], state[3:]
    mesh = irregular(0.6, 0.2, (6, 2), kind=kind)
    load = np.zeros(6 * len(mesh.nodes))
    for name, sign in (("left_edge", -1.0), ("right_edge", 1.0)):
        load[freedoms(mesh.node_set(name), [4])] = sign * 0.2 * np.array([0.25, 0.5, 0.25])
    exact = field(mesh.nodes.numpy(), eps, kappa).ravel()
    held = freedoms([mesh.node("center")])
    u = solved(stiffness(PlateMatrices(mesh, laminate), laminate), load, held, exact)
    assert abs(u - exact).max() < 1e-9 * abs(exact).max()
    if degrees in ([30], [-30]):  # fibres at +30 degrees: a sagging strip twists with the opposite sign
        assert np.sign(kappa[2]) == -np.sign(degrees[0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fraction", [1.0, 0.1, 0.01])
def test_constant_shear_with_rotations_held_is_met_in_the_thick_limit(fraction, kind):
    """The error falls with (element / shear length)^2: a gap is shared with bending, see triangle.py."""
    length = 0.1 * fraction
    laminate = Laminate(CARBON, deg([20, -50]), 0.05)
    mesh = irregular(length, length, (4, 4), kind=kind)
    plate = PlateMatrices(mesh, laminate)
    gamma = np.array([0.7, -0.4])
    exact = np.zeros((len(mesh.nodes), 6))
    exact[:, 2] = mesh.nodes[:, :2].numpy() @ gamma
    n = len(mesh.nodes)
    held = np.union1d(freedoms(boundary(mesh)), freedoms(range(n), [0, 1, 3, 4, 5]))
    K = stiffness(plate, laminate)
    u = solved(K, np.zeros(6 * n), held, exact.ravel())
    energy = length**2 / 2 * gamma @ laminate.stiffness().As.detach().numpy() @ gamma
    assert u @ K @ u / 2 == pytest.approx(energy, rel=0.05 * fraction**2)
    assert abs(u - exact.ravel()).max() < 0.01 * fraction**2 * abs(exact).max()


@pytest.mark.parametrize("kind", KINDS)
def test_twisted_facets_keep_rigid_motion(kind):
    """A mesh that is not flat: neighbouring facets disagree about normals, yet rigid motion is free."""
    mesh = mapped((6, 2), lambda s, t: (2 * s, (t - 0.5) * np.cos(s), (t - 0.5) * np.sin(s)), kind)
    plate = PlateMatrices(mesh, GENERAL)
    K = stiffness(plate, GENERAL)
    x = mesh.nodes.numpy()
    omega, shift = np.array([0.3, -0.5, 0.2]), np.array([1.0, 2.0, -0.4])
    rigid = np.concatenate([shift + np.cross(omega, x), np.tile(omega, (len(x), 1))], axis=1).ravel()
    assert abs(K @ rigid).max() < 1e-12 * abs(K).max()
