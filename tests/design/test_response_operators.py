"""Arithmetic and comparisons of responses as people write them, and what is refused of it."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import ANY, refused, warned

ENERGY = mbd.StrainEnergy("rod")
REACH = mbd.Position("rod", "x", node="right")


@pytest.fixture(scope="module")
def motion() -> mbd.Trajectory:
    return mbd.simulate(pendulum(), 0.02, steps=10, gradients="forward")


def test_quotients(motion):
    y, z = (h.series(motion) for h in (ENERGY / 4.0, ENERGY * 0.25))
    assert_close(y.value, z.value, rtol=1e-14, atol=0.0)
    assert_close(y.gradient, z.gradient, rtol=1e-14, atol=0.0)
    a, b = (m.of(motion) for m in (mbd.Max(ENERGY) / 4, 0.25 * mbd.Max(ENERGY)))
    assert_close(a.value, b.value, rtol=1e-14, atol=0.0)
    assert_close(a.gradient, b.gradient, rtol=1e-14, atol=0.0)
    ratio = (ENERGY / REACH).series(motion)  # of two histories: the quotient rule, rates included
    e, r = ENERGY.series(motion), REACH.series(motion)
    assert e.gradient is not None
    assert r.gradient is not None
    slope = (e.gradient - (e.value / r.value)[..., None] * r.gradient) / r.value[..., None]
    assert_close(ratio.gradient, slope, rtol=1e-10, atol=1e-18)
    rates, step = (ENERGY / REACH).rates(motion), motion.t[1]
    assert rates is not None
    by_steps = (ratio.value[:, 2:] - ratio.value[:, :-2]) / (2.0 * step)
    assert_close(rates[0][:, 1:-1], by_steps, rtol=0.0, atol=0.1 * float(by_steps.abs().max()))


@pytest.mark.parametrize("divisor", [0, 0.0, "2", None, float("nan"), True])
def test_divisors_that_are_none(divisor):
    with refused("divisor"):
        _ = mbd.Max(ENERGY) / divisor


def test_a_chain_of_comparisons_is_refused():
    """Python would drop the first."""
    with refused("constraint", ANY, "two constraints"):
        _ = 0.1 <= mbd.Max(ENERGY) <= 1.0


@pytest.mark.parametrize(
    "function", [lambda m: m.q[..., 0] + 0j, lambda m: m.q[..., 0] > 0, lambda m: m.q[..., 0].long()]
)
def test_functions_return_real_numbers(motion, function):
    with refused("response.<lambda>"):
        mbd.history(function).values(motion)
    assert torch.isfinite(mbd.history(lambda m: m.q[..., 0]).values(motion)).all()


def test_a_function_that_cuts_its_gradient_is_named(motion):
    def peak(motion):
        return torch.tensor([float(x) for x in motion.body("rod").strain_energy.amax(1)], dtype=torch.float64)

    with warned("response 'peak'", ".item()"):
        mbd.measure(peak).value_and_gradient(motion)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mbd.measure(lambda motion: motion.body("rod").strain_energy.amax(1)).value_and_gradient(motion)
