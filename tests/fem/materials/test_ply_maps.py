"""Ply strains and stresses: a published laminate, resultants, and derivatives."""

import pytest
import torch
from torch.func import functional_call, jacfwd, jacrev
from torch.testing import assert_close

from torchmbd.fem.materials import Laminate, Ply, ply_maps
from torchmbd.fem.materials.laminate import strain_rotations
from torchmbd.math.angles import deg

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.0e9, G23=3.9e9, nu12=0.23, density=1586.0)
GLASS = Ply(E1=39e9, E2=8.6e9, G12=3.8e9, G13=3.8e9, G23=3.0e9, nu12=0.28, density=2100.0)


def general():
    return Laminate([CARBON, GLASS, CARBON], deg([20, -50, 75]), [1e-3, 2e-3, 1.5e-3])


def in_plate_axes(laminate, stress):
    """Turn ply stresses [layers, 2, 5, ...] back: (xx, yy, xy), (xz, yz)."""
    T, R = strain_rotations(laminate.layer_angles)
    return torch.einsum("lij,lfi...->lfj...", T, stress[:, :, :3]), torch.einsum(
        "lij,lfi...->lfj...", R, stress[:, :, 3:]
    )


def test_kaw_0_30_minus_45():
    """N_xx = N_yy = 1000 N/m on a graphite/epoxy stack of three layers of 5 mm.

    A. K. Kaw, Mechanics of Composite Materials, 2nd ed., example 4.3: strains of the mid-surface and curvatures, and
    global stresses of the first face (tables 4.1, 4.2). His z axis points down: his top is our bottom.
    """
    ply = Ply(E1=181e9, E2=10.3e9, G12=7.17e9, G13=7.17e9, G23=7.17e9, nu12=0.28, density=1.0)
    laminate = Laminate(ply, deg([0, 30, -45]), 5e-3)
    A, B, D, _ = laminate.stiffness()
    law = torch.cat([torch.cat([A, B], 1), torch.cat([B, D], 1)], 0).detach()
    strains = torch.linalg.solve(law, torch.tensor([1000.0, 1000.0, 0, 0, 0, 0], dtype=torch.float64))
    expected = [3.123e-7, 3.492e-6, -7.598e-7, 2.971e-5, -3.285e-4, 4.101e-4]
    assert strains.tolist() == pytest.approx(expected, rel=5e-4)
    maps = ply_maps(laminate)
    state = torch.cat([strains, torch.zeros(2, dtype=torch.float64)])
    assert (maps.strain @ state)[0, 0, :3].tolist() == pytest.approx([8.944e-8, 5.955e-6, -3.836e-6], rel=5e-4)
    plane, _ = in_plate_axes(laminate, maps.stress @ state)
    assert plane[0, 0].tolist() == pytest.approx([3.351e4, 6.188e4, -2.750e4], rel=5e-4)


def test_stresses_add_up_to_the_forces_of_the_laminate():
    """N, M and Q of a general state by Simpson's rule through the layers; no entry of any map is spared."""
    laminate = general()
    state = torch.tensor([1e-3, -2e-3, 3e-3, 0.4, -0.7, 0.5, 2e-3, -1e-3], dtype=torch.float64)
    A, B, D, As = (x.detach() for x in laminate.stiffness())
    stress = (ply_maps(laminate).stress @ state).detach()
    plane, shear = (x.detach() for x in in_plate_axes(laminate, stress))
    h, z = laminate.thickness.detach()[:, None], laminate.faces.detach()[..., None]
    N = (h * plane.mean(1)).sum(0)
    middle = z.mean(1) * plane.mean(1)
    M = (h / 6 * (z[:, 0] * plane[:, 0] + 4 * middle + z[:, 1] * plane[:, 1])).sum(0)
    assert_close(N, A @ state[:3] + B @ state[3:6])
    assert_close(M, B @ state[:3] + D @ state[3:6])
    Q = As @ state[6:]
    between = (laminate.shear_shape().at(0.5) @ Q).detach()
    assert_close((h / 6 * (shear[:, 0] + 4 * between + shear[:, 1])).sum(0), Q)
    assert float(shear[0, 0].abs().max()) == 0
    assert_close(shear[1:, 0], shear[:-1, 1])


def test_strain_and_stress_obey_the_ply():
    laminate = general()
    maps = ply_maps(laminate)
    for k, ply in enumerate(laminate.layer_plies):
        law = torch.block_diag(ply.plane_stiffness(), ply.shear_stiffness())
        assert_close(law @ maps.strain[k], maps.stress[k], rtol=1e-11, atol=1e-3)


def test_a_symmetric_stack_has_maps_for_both_halves():
    half = Laminate([CARBON, GLASS], deg([20, -50]), [1e-3, 2e-3], symmetric=True)
    whole = Laminate([CARBON, GLASS, GLASS, CARBON], deg([20, -50, -50, 20]), [1e-3, 2e-3, 2e-3, 1e-3])
    for one, other in zip(ply_maps(half), ply_maps(whole), strict=True):
        assert one.shape == (4, 2, 5, 8)
        assert_close(one, other, rtol=1e-12, atol=1e-6)


def test_derivatives_by_the_angles_and_lanes():
    class Stress(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.laminate = general()

        def forward(self):
            return ply_maps(self.laminate).stress

    module = Stress()

    def function(angles):
        return functional_call(module, {"laminate.angles": angles})

    angles = module.laminate.angles.detach()
    forward = jacfwd(function)(angles)
    assert_close(forward, jacrev(function)(angles), rtol=1e-9, atol=1e-3)
    for i in range(3):
        step = 1e-6 * torch.eye(3, dtype=torch.float64)[i]
        difference = (function(angles + step) - function(angles - step)) / 2e-6
        assert_close(forward[..., i], difference, rtol=1e-6, atol=1e-8 * float(difference.abs().max()))
    lanes = torch.stack([angles, angles.flip(0)])
    alone = function(lanes[1])
    assert_close(function(lanes)[1], alone, rtol=1e-13, atol=1e-16 * float(alone.abs().max()))
