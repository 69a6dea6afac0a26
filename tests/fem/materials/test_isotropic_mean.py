"""IsotropicMean: exact for an isotropic plate, and blind to ply angles (so that an element may rely on it)."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.fem.materials import IsotropicMean, Laminate, LaminateStiffness, Ply

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.0e9, G23=3.9e9, nu12=0.23, density=1586.0)
ANGLES = st.lists(st.floats(-math.pi / 2, math.pi / 2), min_size=3, max_size=3)


def test_isotropic_plate_is_its_own_mean():
    mean = IsotropicMean.of(Laminate(Ply.isotropic(70e9, 0.33, 2700.0), [0.4], 2e-3))
    assert mean.poisson == pytest.approx(0.33, rel=1e-12)
    D, As = 70e9 * 8e-9 / 12 / (1 - 0.33**2), 5 / 6 * 70e9 / 2.66 * 2e-3
    assert mean.shear_length == pytest.approx(math.sqrt(12 * D / As), rel=1e-12)
    assert mean.layer_length == pytest.approx(2e-3 / math.sqrt(10.0), rel=1e-12)  # of Mindlin's plate: h / sqrt 10


@pytest.mark.thorough
@given(one=ANGLES, two=ANGLES)
@settings(max_examples=30, deadline=None)
def test_ply_angles_do_not_enter(one, two):
    a, b = (IsotropicMean.of(Laminate(CARBON, angles, [1e-3, 2e-3, 3e-3])) for angles in (one, two))
    assert a.poisson == pytest.approx(b.poisson, rel=1e-11)
    assert a.shear_length == pytest.approx(b.shear_length, rel=1e-11)


def test_bad_input_is_named():
    with pytest.raises(InputError) as error:
        IsotropicMean(1.2, 1e-3)
    assert (error.value.path, error.value.value) == (("poisson",), 1.2)
    with pytest.raises(InputError) as error:
        IsotropicMean(0.3, 0.0)
    assert (error.value.path, error.value.value) == (("shear_length",), 0.0)
    lanes = LaminateStiffness(*(torch.eye(k, dtype=torch.float64).expand(2, k, k) for k in (3, 3, 3, 2)))
    with refused("laminate"):
        IsotropicMean.of(lanes)
