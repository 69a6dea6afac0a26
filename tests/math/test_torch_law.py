import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchmbd as mbd
from tests.refused import refused
from torchmbd.math.torch_law import PLACES, require_differentiable

LAWS = {
    "cycloid": lambda t: t - torch.sin(2 * math.pi * t) / (2 * math.pi),
    "fast cycloid": lambda t: 0.05 * (t / 0.05 - torch.sin(2 * math.pi * t / 0.05) / (2 * math.pi)),
    "3-4-5 polynomial": lambda t: 10 * t**3 - 15 * t**4 + 6 * t**5,
    "signed square": lambda t: t * t.abs(),
    "from a time on": lambda t: (t - 0.57).clamp(min=0.0) ** 3,
    "constant": lambda t: 0.0 * t + 2.0,
    "flat function": lambda t: torch.exp(-1.0 / t.square().clamp(min=1e-6)),
}


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_smooth_laws_are_accepted(law):
    require_differentiable("angle", law, "a function of torch")


@given(st.sampled_from(PLACES), st.integers(2, 9), st.floats(1e-3, 1e3))
@settings(max_examples=30, deadline=None)
def test_the_slope_may_vanish_at_any_place(place, power, factor):
    require_differentiable("angle", lambda t: factor * (t - place) ** power, "a function of torch")


LOST = {
    "float": lambda t: torch.tensor(float(t) ** 3, dtype=torch.float64),
    "item": lambda t: torch.tensor(math.sin(t.item()), dtype=torch.float64),
    "detach": lambda t: t.detach() ** 3 + 0.0 * t,
    "late pulse": lambda t: 0.0 * t + ((t.detach() - 0.2) * (0.4 - t.detach())).clamp(min=0.0),
    "NumPy": lambda t: torch.as_tensor(np.interp(float(t), [-1.0, 2.0], [0.0, 1.0]), dtype=torch.float64),
}


@pytest.mark.parametrize("law", LOST.values(), ids=LOST)
def test_laws_that_leave_torch_are_refused(law):
    with refused("angle"):
        require_differentiable("angle", law, "a function of torch")


@pytest.mark.parametrize(
    ("law", "lost"),
    [
        (lambda s, rate, t: -2.0 * s**3 - rate**3, False),
        (lambda s, rate, t: -2.0 * s - rate * rate.abs(), False),
        (lambda s, rate, t: -2.0 * s - 0.1 * rate.detach(), True),
        (lambda s, rate, t: 5.0 * torch.clamp_min(-s, 0.0).detach() - rate, True),
    ],
    ids=["cubic", "signed square", "rate detached", "negative side detached"],
)
def test_laws_of_forces_are_compared_by_coordinate_and_rate_on_both_sides_of_zero(law, lost):
    def spring():
        ground, slider = mbd.Ground(), mbd.RigidBody("slider", 1.0, (0.01,) * 3)
        return mbd.SpringDamper(ground.at(), slider.at(1.0, 0.0, 0.0), law=law)

    if lost:
        with refused("springdamper_ground_slider.law"):
            spring()
    else:
        spring()
