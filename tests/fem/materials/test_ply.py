"""Ply: its stiffness is the inverse of the compliance that defines it; wrong constants are named."""

import dataclasses
import math

import pytest
import torch
from torch.testing import assert_close

from tests.refused import refused
from torchmbd.fem.materials import Ply

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.0e9, G23=3.9e9, nu12=0.23, density=1586.0)


def test_stiffness_inverts_the_compliance():
    c = CARBON
    compliance = torch.tensor(
        [[1 / c.E1, -c.nu12 / c.E1, 0], [-c.nu12 / c.E1, 1 / c.E2, 0], [0, 0, 1 / c.G12]], dtype=torch.float64
    )
    assert_close(c.plane_stiffness() @ compliance, torch.eye(3, dtype=torch.float64), rtol=1e-13, atol=1e-13)
    assert_close(c.shear_stiffness(), torch.tensor([[5.0e9, 0.0], [0.0, 3.9e9]], dtype=torch.float64))


def test_isotropic_ply_has_one_shear_modulus():
    steel = Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    assert steel.G12 == steel.G13 == steel.G23 == 210e9 / 2.6
    assert steel.plane_stiffness()[0, 0].item() == pytest.approx(210e9 / (1 - 0.09), rel=1e-14)


@pytest.mark.parametrize("name", ["E1", "E2", "G12", "G13", "G23", "density"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, "1e9"])
def test_bad_constant_is_named(name, value):
    with refused(name):
        dataclasses.replace(CARBON, **{name: value})


@pytest.mark.parametrize("nu12", [3.6, -3.6, math.nan])
def test_energy_must_be_positive(nu12):
    """sqrt(E1 / E2) = 3.56: beyond it some strain would release energy."""
    with refused("nu12"):
        dataclasses.replace(CARBON, nu12=nu12)


@pytest.mark.parametrize("nu", [-1.0, 0.51])
def test_isotropic_poisson_is_bounded(nu):
    with refused("nu"):
        Ply.isotropic(E=1.0, nu=nu, density=1.0)
