"""The orthotropic solid: its law, its completion from a ply, its rotation, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.fem.sections import Orthotropic
from torchmbd.fem.sections.orthotropic import in_wall_axes, strain_rotation

GIVEN = {
    "E1": 130e9, "E2": 10e9, "E3": 8e9, "G12": 5e9, "G13": 4e9, "G23": 3e9,
    "nu12": 0.3, "nu13": 0.25, "nu23": 0.4, "density": 1600.0,
}  # fmt: skip


def test_uniaxial_stress_makes_the_strains_of_the_constants():
    C = Orthotropic(**GIVEN).stiffness()
    for i, (modulus, strains) in enumerate(
        (
            (130e9, (1.0, -0.3, -0.25)),
            (10e9, (-0.3 * 10 / 130, 1.0, -0.4)),
            (8e9, (-0.25 * 8 / 130, -0.4 * 8 / 10, 1.0)),
        )
    ):
        stress = torch.zeros(6, dtype=torch.float64)
        stress[i] = modulus
        expected = torch.tensor([*strains, 0, 0, 0], dtype=torch.float64)
        assert_close(torch.linalg.solve(C, stress), expected, rtol=1e-12, atol=1e-14)
    assert_close(C.diagonal()[3:], torch.tensor([3e9, 4e9, 5e9], dtype=torch.float64))


def test_a_ply_is_completed_as_transversely_isotropic():
    """Turned about its fibre by any angle, such a solid is the same."""
    solid = Orthotropic.of(mbd.Ply(E1=130e9, E2=10e9, G12=5e9, G13=5e9, G23=3.6e9, nu12=0.3, density=1600.0))
    C, angle = solid.stiffness(), 0.7
    c, s = math.cos(angle), math.sin(angle)
    R = torch.tensor([[1, 0, 0], [0, c, s], [0, -s, c]], dtype=torch.float64)
    assert_close(tensor_rotated(C, R), C, rtol=1e-12, atol=1e-3)
    aluminium = mbd.Ply.isotropic(70e9, 0.33, 2700.0)
    metal = Orthotropic.isotropic(70e9, 0.33, 2700.0)
    assert_close(Orthotropic.of(aluminium).stiffness(), metal.stiffness(), rtol=1e-12, atol=1e-3)


def tensor_rotated(C, R):
    """Voigt -> fourth-order tensor -> turned -> Voigt."""
    pairs = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
    full = torch.zeros(3, 3, 3, 3, dtype=torch.float64)
    for a, (i, j) in enumerate(pairs):
        for b, (k, m) in enumerate(pairs):
            for p, q in {(i, j), (j, i)}:
                for r, s in {(k, m), (m, k)}:
                    full[p, q, r, s] = C[a, b]
    full = torch.einsum("ai,bj,ck,dm,ijkm->abcd", R, R, R, R, full)
    return torch.stack([torch.stack([full[i, j, k, m] for k, m in pairs]) for i, j in pairs])


def test_rotation_is_that_of_the_fourth_order_tensor():
    C, theta = Orthotropic(**GIVEN).stiffness(), torch.tensor([0.6], dtype=torch.float64)
    c, s = math.cos(0.6), math.sin(0.6)
    to_wall = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)  # columns: ply axes in wall axes
    # the wall's order of components is xx, ss, nn, sn, xn, xs: that of the ply
    assert_close(in_wall_axes(C[None], theta)[0], tensor_rotated(C, to_wall), rtol=1e-12, atol=1e-3)
    T = strain_rotation(theta)
    assert_close(T @ strain_rotation(-theta), torch.eye(6, dtype=torch.float64)[None])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"E3": 0.0}, ["E3 = 0.0", "finite number > 0"]),
        ({"G13": math.nan}, ["G13 = nan"]),
        ({"density": "heavy"}, ["density = 'heavy'"]),
        ({"nu23": 1.3}, ["nu23 = 1.3", "not positive definite"]),
        ({"nu12": math.inf}, ["nu12 = inf"]),
    ],
)
def test_bad_constants_are_named(change, words):
    with pytest.raises(InputError) as error:
        Orthotropic(**(GIVEN | change))
    for word in words:
        assert word in str(error.value)


def test_a_ply_without_a_solid_is_refused():
    """G23 below E2 / 4 asks for nu23 > 1."""
    with refused("ply"):
        Orthotropic.of(mbd.Ply(E1=130e9, E2=10e9, G12=5e9, G13=5e9, G23=2e9, nu12=0.3, density=1600.0))
    with pytest.raises(InputError) as error:
        Orthotropic.of("carbon")  # pyright: ignore[reportArgumentType]
    assert (error.value.path, error.value.value) == (("ply",), "carbon")
    with pytest.raises(InputError) as error:
        Orthotropic.isotropic(1e9, 0.5, 1.0)
    assert (error.value.path, error.value.value) == (("nu",), 0.5)
