"""Deviations that are estimated: intervals hold the truth as often as they say, and know when nothing is known."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.extensions.identification.closed_form import fit

SHARED = {"k": 2.0}


def line(b, x):
    return b["k"] * x


def sensor(b, x):
    """A channel of few numbers with a gain and an offset of its own."""
    return b["gain"] * b["k"] * x + b["offset"]


@pytest.mark.thorough
@pytest.mark.parametrize(("few", "deviation"), [(4, None), (4, 0.05), (3, None)])
def test_coverage_of_intervals(few, deviation):
    """95 % intervals of 300 draws hold the truth in 90 to 98 % of them, for each unknown."""
    rng, held, count = np.random.default_rng(11), np.zeros(3), 300
    many, x = np.linspace(0.2, 1.0, 25), np.linspace(0.3, 1.2, few)
    truth = np.array([2.0, 1.5, 0.4])
    for _ in range(count):
        y = truth[0] * many + 0.02 * rng.standard_normal(25)
        z = truth[1] * truth[0] * x + truth[2] + 0.05 * rng.standard_normal(few)
        given = None if deviation is None else 0.02
        channels = {"many": (many, y, given, line), "few": (x, z, deviation, sensor)}
        result = fit(channels, {"k": 1.8, "gain": 1.0, "offset": 0.0})
        assert result.converged, result.message
        low, high = result.interval.T
        held += (low < truth) & (truth < high)
    shares = held / count
    assert ((shares >= 0.90) & (shares <= 0.98)).all(), shares


def test_a_few_numbers_do_not_outvote_many():
    """Three readings, 10 % off, agree with each other better than twenty good ones do."""
    rng = np.random.default_rng(2)
    x = np.linspace(0.5, 1.5, 20)
    channels = {
        "good": (x, 2.0 * x + 0.02 * rng.standard_normal(20), None, line),
        "wrong": (np.ones(3), 2.2 + 1e-3 * rng.standard_normal(3), None, line),
    }
    result = fit(channels, {"k": 1.8})
    low, high = result.interval[0]
    assert result.converged
    assert low < 2.0 < high
    assert high - low < 0.04


def test_as_many_unknowns_as_numbers_say_nothing_of_the_noise():
    x, y = np.array([1.0, 2.0]), np.array([2.2, 3.9])
    result = fit({"y": (x, y, None, lambda b, x: b["k"] * x + b["c"])}, {"k": 1.0, "c": 0.0})
    assert np.isinf(result.interval).all()
    assert "nothing is known of the noise" in str(result)
    given = fit({"y": (x, y, 0.1, lambda b, x: b["k"] * x + b["c"])}, {"k": 1.0, "c": 0.0})
    J = np.stack([x, np.ones(2)], 1) / 0.1
    expected = 1.959964 * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    np.testing.assert_allclose(given.interval[:, 1] - given.x, expected, rtol=1e-5)


def test_a_channel_without_freedoms_leaves_the_others_alone():
    """Two numbers with a gain and an offset of their own say nothing; the shared unknown is that of the other channel."""
    rng, x = np.random.default_rng(0), np.linspace(0.5, 1.5, 20)
    y = 2.0 * x + 0.02 * rng.standard_normal(20)
    both = {"y": (x, y, None, line), "z": (np.array([0.5, 1.0]), np.array([1.9, 3.6]), None, sensor)}
    result = fit(both, {"k": 1.8, "gain": 1.0, "offset": 0.0})
    alone = fit({"y": (x, y, None, line)}, {"k": 1.8})
    np.testing.assert_allclose(result.interval[0], alone.interval[0], rtol=1e-6)
    assert np.isinf(result.interval[1:]).all()


def test_profile_without_freedoms_has_no_end():
    result = fit({"y": (np.ones(1), np.ones(1), None, line)}, SHARED)
    assert result.profile("k") == (-np.inf, np.inf)
    assert isinstance(result, mbd.identification.Identification)
