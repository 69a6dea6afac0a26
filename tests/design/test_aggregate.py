"""Aggregates: their bounds in closed form, problems that they stand for, and how sharp they become."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from torchmbd.design.sharpening import sharpened

LAG = mbd.Displacement("arm", "z", node="right")
ROWS = mbd.AtTimes(LAG, count=9)


@pytest.fixture(scope="module")
def motion() -> mbd.Trajectory:
    return mbd.simulate(mbd.examples.arm(), 0.1, steps=40)


@pytest.mark.parametrize("sharpness", [1.0, 30.0, 1e6])
def test_both_kinds_lie_within_their_bounds(motion, sharpness):
    rows = ROWS(motion)
    largest, count = float(rows.max()), rows.shape[1]
    ks, norm = mbd.Aggregate(ROWS, "ks", sharpness, scale=1e-3), mbd.Aggregate(ROWS, "p_norm", sharpness)
    assert largest <= float(ks(motion)) <= largest + 1e-3 * math.log(count) / sharpness
    assert largest * (1.0 - 1e-12) <= float(norm(motion)) <= largest * count ** (1.0 / sharpness) * (1.0 + 1e-12)
    assert float(ks.largest(motion)) == float(norm.largest(motion)) == largest


def test_several_measures_and_what_they_are_by_hand(motion):
    both = [mbd.Max(LAG), mbd.Final(LAG)]
    a, b = (float(m(motion)) for m in both)
    result = mbd.Aggregate(both, "ks", 4.0, 2e-3)(motion)
    assert float(result) == pytest.approx(5e-4 * math.log(math.exp(a / 5e-4) + math.exp(b / 5e-4)), rel=1e-12)
    result = mbd.Aggregate(both, "p_norm", 3.0)(motion)
    assert float(result) == pytest.approx((max(a, 0.0) ** 3 + max(b, 0.0) ** 3) ** (1.0 / 3.0), rel=1e-12)


def problem(kind: str, sharpness: float, **options) -> mbd.Problem:
    """Least energy of two ply angles whose deflection is limited."""
    limit = mbd.Aggregate(mbd.AtTimes(LAG, count=21), kind, sharpness, **options)
    minimize = mbd.Integral(mbd.StrainEnergy("arm"))
    return mbd.Problem(mbd.examples.arm(), 0.1, minimize, [limit <= 0.9 * 1.29e-3], mbd.deg([-90, 90]), steps=40)


@pytest.mark.thorough
def test_sharpening_ends_near_the_rows_and_keeps_them():
    """Minimize the largest deflection: aggregates sharpen until they are within the tolerance of the row itself."""
    worst = mbd.Aggregate(mbd.AtTimes(LAG, count=21), "p_norm", 4.0)
    given = mbd.Problem(mbd.examples.arm(), 0.1, worst, (), mbd.deg([-90, 90]), steps=40)
    rounds = mbd.sharpen(given, "slsqp", tolerance=0.02, max_iterations=8)
    assert rounds[0].gap > 0.02 >= rounds[-1].gap
    assert [r.factor for r in rounds] == sorted({r.factor for r in rounds})
    assert rounds[-1].largest[0] <= rounds[0].largest[0] * (1.0 + 1e-6)
    exact = mbd.AtTimes(LAG, count=21)(given.motion(rounds[-1].result.x)).max()
    assert rounds[-1].largest[0] == pytest.approx(float(exact), rel=1e-12)
    assert rounds[-1].aggregates[0] == pytest.approx(rounds[-1].result.value, rel=1e-9)


@pytest.mark.thorough
def test_a_sharpened_problem_is_another(motion):
    given = problem("ks", 10.0, scale=1e-3)
    [limit] = given.constraints
    [sharper] = sharpened(given, 3.0).constraints
    assert (limit.measure.sharpness, sharper.measure.sharpness) == (10.0, 30.0)
    values = [p.evaluate(p.start[None], False)[0].constraints[0] for p in (given, sharpened(given, 3.0))]
    assert values[0] > values[1]
    assert float(mbd.Max(LAG)(motion)) > 0.0


@pytest.mark.thorough
def test_scenarios_are_aggregated_by_their_largest():
    worst = mbd.Aggregate(mbd.AtTimes(LAG, count=9), "p_norm", 4.0)
    made = {"thick": {"arm.laminate.thickness": 1e-3}, "thin": {"arm.laminate.thickness": 9e-4}}
    given = mbd.Scenarios(
        mbd.examples.arm(), 0.05, worst, scenarios=made, objective="mean", bounds=mbd.deg([-90, 90]), steps=20
    )
    (result,) = mbd.sharpen(given, tolerance=0.9, max_iterations=0)
    motions = given.motions(result.result.x)
    np.testing.assert_allclose(result.largest, [float(worst.largest(motions).max())], rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: mbd.Aggregate(LAG), "measures"),
        (lambda: mbd.Aggregate([]), "measures"),
        (lambda: mbd.Aggregate(ROWS, "max"), "kind"),
        (lambda: mbd.Aggregate(ROWS, sharpness=0.0, scale=1.0), "sharpness"),
        (lambda: mbd.Aggregate(ROWS), "scale"),
        (lambda: mbd.Aggregate(ROWS, scale=-1.0), "scale"),
        (lambda: mbd.SmoothMax(LAG), "scale"),
        (lambda: mbd.Aggregate(ROWS, "p_norm", scale=2.0), "scale"),
        (lambda: mbd.sharpen(problem("ks", 9.0, scale=1e-3), tolerance=-1.0), "tolerance"),
        (lambda: mbd.sharpen("mine"), "problem"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_refusals(make, path):
    with refused(path):
        make()


def test_a_problem_without_aggregates_is_refused():
    plain = mbd.Problem(mbd.examples.arm(), 0.05, mbd.Max(LAG), steps=20)
    with refused("problem"):
        mbd.sharpen(plain)


def test_rows_below_zero_count_as_nothing_in_a_norm(motion):
    below = mbd.Aggregate([mbd.Max(LAG), mbd.Min(LAG) - 1.0], "p_norm", 2.0)
    assert float(below(motion)) == pytest.approx(float(mbd.Max(LAG)(motion)), rel=1e-12)
    assert torch.isfinite(below(motion)).all()


def test_a_norm_of_rows_that_are_all_below_zero_is_refused(motion):
    """It would be zero without a gradient."""
    with refused("kind", "p_norm", "design 1", "positive", kind=mbd.DesignFailure):
        mbd.Aggregate([mbd.Max(LAG) - 1.0, mbd.Min(LAG) - 1.0], "p_norm", 2.0)(motion)
