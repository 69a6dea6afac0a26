"""Laminate: against a direct integral of the ply energy through the thickness, and by the laws of lamination."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.func import functional_call, jacfwd, jacrev, vmap
from torch.testing import assert_close

from tests.refused import refused
from torchmbd.fem.materials import ENTRIES, Laminate, Ply
from torchmbd.math.angles import deg

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.0e9, G23=3.9e9, nu12=0.23, density=1586.0)
GLASS = Ply(E1=39e9, E2=8.6e9, G12=3.8e9, G13=3.8e9, G23=3.0e9, nu12=0.28, density=2100.0)
ANGLES = st.floats(-math.pi / 2, math.pi / 2)


def energy_per_area(laminate, eps, kappa, gamma):
    """Energy of a plate state, by turning the strain tensor into each ply and by Gauss points through it."""
    angles, t = laminate.angles.tolist(), laminate.thickness.tolist()
    plies = [CARBON, GLASS, CARBON]
    z, total = -sum(t) / 2, 0.0
    points, weights = np.polynomial.legendre.leggauss(2)
    for ply, theta, h in zip(plies, angles, t, strict=True):
        R = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
        for x, w in zip(points, weights, strict=True):
            e = eps + (z + h * (1 + x) / 2) * kappa
            tensor = R.T @ np.array([[e[0], e[2] / 2], [e[2] / 2, e[1]]]) @ R
            own = np.array([tensor[0, 0], tensor[1, 1], 2 * tensor[0, 1]])
            out = R.T @ gamma
            own_energy = own @ ply.plane_stiffness().numpy() @ own
            shear_energy = laminate.shear_correction * out @ ply.shear_stiffness().numpy() @ out
            total += w * h / 2 * (own_energy + shear_energy) / 2
        z += h
    return total


@pytest.mark.thorough
@given(angles=st.lists(ANGLES, min_size=3, max_size=3), state=st.lists(st.floats(-1, 1), min_size=8, max_size=8))
@settings(max_examples=40, deadline=None)
def test_energy_is_the_integral_over_the_plies(angles, state):
    laminate = Laminate([CARBON, GLASS, CARBON], angles, [1e-3, 2e-3, 1.5e-3], shear_correction=0.7)
    e = np.array(state[:3]) * 1e-3, np.array(state[3:6]), np.array(state[6:]) * 1e-3
    A, B, D, As = (x.detach().numpy() for x in laminate.stiffness())
    energy = (e[0] @ A @ e[0] + 2 * e[0] @ B @ e[1] + e[1] @ D @ e[1] + e[2] @ As @ e[2]) / 2
    assert energy == pytest.approx(energy_per_area(laminate, *e), rel=1e-12, abs=1e-12)


def test_signs_of_an_unbalanced_stack():
    """Fibres at +30 degrees shear with a pull in x; more of them on top bends and shears with the same sign."""
    A, B, D, _ = Laminate(CARBON, deg([30]), 1e-3).stiffness()
    assert A[0, 2] > 0
    assert D[0, 2] > 0
    assert abs(B).max() < 1e-6
    assert Laminate(CARBON, deg([-30, 30]), 1e-3).stiffness().B[0, 2] > 0
    assert Laminate(CARBON, deg([90, 0]), 1e-3).stiffness().B[0, 0] > 0  # the stiff ply is on top


def test_symmetric_stack_mirrors_the_lower_half():
    half = Laminate([CARBON, GLASS], deg([20, -70]), [1e-3, 2e-3], symmetric=True)
    full = Laminate([CARBON, GLASS, GLASS, CARBON], deg([20, -70, -70, 20]), [1e-3, 2e-3, 2e-3, 1e-3])
    assert half.angles.shape == (2,)
    assert_close(half.entries(), full.entries(), rtol=1e-13, atol=1e-9)
    assert_close(half.stiffness().B, torch.zeros(3, 3, dtype=torch.float64), rtol=0, atol=1e-8)
    assert_close(half.mass_per_area, full.mass_per_area)
    assert_close(half.rotary_inertia_per_area, full.rotary_inertia_per_area)


@pytest.mark.thorough
@given(angles=st.lists(ANGLES, min_size=1, max_size=4))
@settings(max_examples=30, deadline=None)
def test_turning_the_stack_over_reverses_only_the_coupling(angles):
    up, down = Laminate(CARBON, angles, 1e-3).stiffness(), Laminate(CARBON, angles[::-1], 1e-3).stiffness()
    for name, sign in (("A", 1), ("B", -1), ("D", 1), ("As", 1)):
        x, y = getattr(up, name), getattr(down, name)
        assert_close(x, sign * y, rtol=1e-11, atol=1e-11 * 128e9 * 1e-3)


@pytest.mark.thorough
@given(angles=st.lists(ANGLES, min_size=1, max_size=3), turn=ANGLES)
@settings(max_examples=30, deadline=None)
def test_turning_every_ply_turns_the_stiffness_tensor(angles, turn):
    """Compared as fourth-order tensors, which know nothing of engineering shear; As of the sum of the plies is one, too."""
    old, new = (Laminate(CARBON, a, 1e-3, shear_correction=5 / 6) for a in (angles, [a + turn for a in angles]))
    R = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], dtype=torch.float64)
    voigt = torch.tensor([[0, 2], [2, 1]])
    for name in ("A", "B", "D"):
        C = getattr(old.stiffness(), name)[voigt[:, :, None, None], voigt]
        turned = torch.einsum("ai,bj,ck,dl,ijkl->abcd", R, R, R, R, C)
        expected = getattr(new.stiffness(), name)[voigt[:, :, None, None], voigt]
        assert_close(turned, expected, rtol=1e-10, atol=1e-10 * float(abs(C.detach()).max()) + 1e-7)
    assert_close(R @ old.stiffness().As @ R.T, new.stiffness().As, rtol=1e-11, atol=1e-3)


def test_mass_and_rotary_inertia():
    laminate = Laminate([CARBON, GLASS], [0.0, 0.0], [1e-3, 3e-3])  # interfaces at -2, -1 and 2 mm
    assert laminate.mass_per_area.item() == pytest.approx(1586 * 1e-3 + 2100 * 3e-3, rel=1e-14)
    expected = (1586 * (8 - 1) + 2100 * (8 + 1)) * 1e-9 / 3
    assert laminate.rotary_inertia_per_area.item() == pytest.approx(expected, rel=1e-13)
    assert laminate.total_thickness.item() == pytest.approx(4e-3, rel=1e-14)


@pytest.mark.parametrize("symmetric", [False, True])
def test_lanes_are_independent_designs(symmetric):
    laminate = Laminate([CARBON, GLASS], [0.1, -0.4], 1e-3, symmetric=symmetric)
    angles = torch.linspace(-1.0, 1.0, 12, dtype=torch.float64).reshape(3, 2, 2)
    thickness = torch.linspace(1e-3, 2e-3, 12, dtype=torch.float64).reshape(3, 2, 2)
    batch = functional_call(laminate, {"angles": angles, "thickness": thickness}, ())
    assert batch.shape == (3, 2, 21)
    for i in range(3):
        for j in range(2):
            single = Laminate([CARBON, GLASS], angles[i, j], thickness[i, j], symmetric=symmetric)
            assert_close(batch[i, j], single.entries(), rtol=1e-13, atol=1e-9)


def test_derivatives_by_angle_and_thickness_agree_with_differences():
    laminate = Laminate([CARBON, GLASS, CARBON], [0.3, -0.9, 1.2], [1e-3, 2e-3, 1.5e-3])
    powers = torch.tensor([{"A": 1, "B": 2, "D": 3, "As": 1}[name] for name, _, _ in ENTRIES])
    size = CARBON.E1 * 4.5e-3**powers  # of each entry: modulus times a power of the height

    def entries(angles, thickness):
        return functional_call(laminate, {"angles": angles, "thickness": thickness}, ()) / size

    point = (laminate.angles.detach(), laminate.thickness.detach())
    for argument, step in ((0, 1e-5), (1, 1e-8)):
        forward = jacfwd(entries, argument)(*point)
        assert_close(forward, jacrev(entries, argument)(*point), rtol=1e-12, atol=1e-12)
        for k in range(3):
            shift = step * torch.eye(3, dtype=torch.float64)[k]
            ends = [
                entries(*(p + sign * shift if i == argument else p for i, p in enumerate(point))) for sign in (1, -1)
            ]
            assert_close(
                forward[:, k], (ends[0] - ends[1]) / (2 * step), rtol=1e-7, atol=1e-7 * float(forward.abs().max())
            )


def test_vmapped_tangents_equal_single_ones():
    laminate = Laminate(CARBON, [0.3, -0.9], 1e-3)
    jacobian = jacfwd(lambda angles: functional_call(laminate, {"angles": angles}, ()))
    lanes = torch.tensor([[0.3, -0.9], [1.0, 0.2]], dtype=torch.float64)
    assert_close(vmap(jacobian)(lanes), torch.stack([jacobian(a) for a in lanes]), rtol=1e-13, atol=1e-6)


def test_entries_follow_their_published_order():
    laminate = Laminate(CARBON, [0.3, -0.9], 1e-3)
    stiffness, entries = laminate.stiffness(), laminate.entries()
    assert len(ENTRIES) == 21
    for value, (name, i, j) in zip(entries, ENTRIES, strict=True):
        assert value == getattr(stiffness, name)[i, j]


def test_one_design_in_a_batch_has_the_bits_of_a_design_without_lanes():
    """Otherwise a body could not use the modes of its construction in its first motion."""
    laminate = Laminate(CARBON, [0.3, -1.1, 0.7], 1e-3)
    batch = functional_call(laminate, {name: x[None] for name, x in laminate.named_parameters()}, ())
    assert torch.equal(batch[0], laminate.entries())


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"angles": [45.0, -45.0]}, "angles.0"),
        ({"angles": [0.0, math.nan]}, "angles.1"),
        ({"angles": []}, "angles"),
        ({"angles": [[0.0]]}, "angles"),
        ({"thickness": [1e-3] * 3}, "thickness"),
        ({"thickness": [1e-3, 0.0]}, "thickness.1"),
        ({"thickness": -1e-3}, "thickness.0"),
        ({"ply": [CARBON]}, "ply"),
        ({"ply": [CARBON, "glass"]}, "ply.1"),
        ({"shear_correction": 0.0}, "shear_correction"),
        ({"shear_correction": 1.2}, "shear_correction"),
    ],
)
def test_bad_input_is_named(arguments, path):
    with refused(path):
        Laminate(**({"ply": CARBON, "angles": [0.0, 0.1], "thickness": 1e-3} | arguments))
