"""A fit is the same in all units of its data and of its unknowns, and whatever is added to its data."""

from __future__ import annotations

import numpy as np
import pytest

from tests.extensions.identification.closed_form import fit

UNITS = [1e-6, 1e-3, 1.0, 1e3, 1e6]
RNG = np.random.default_rng(4)
T = np.linspace(0.0, 2.0, 60)
NOISE = RNG.standard_normal((2, 60))


def fitted(data: float, unknown: float, deviation: bool, start: float = 0.0, constant: float = 0.0):
    """A decay with an offset that starts at zero, and a second channel; data and unknowns in other units."""

    def decay(b, t):
        return data / unknown * (b["a"] * (-b["c"] / unknown * t).exp() + b["offset"])

    def ramp(b, t):
        return data / unknown * (b["a"] * t + b["offset"])

    y = 3.0 * np.exp(-1.3 * T) + 0.2 + 0.05 * NOISE[0] + constant
    z = 3.0 * T + 0.2 + 0.3 * NOISE[1] + constant
    s = (data * 0.05, data * 0.3) if deviation else (None, None)
    channels = {"y": (T, data * y, s[0], decay), "z": (T, data * z, s[1], ramp)}
    result = fit(channels, {"a": 2.0 * unknown, "c": 1.0 * unknown, "offset": start * unknown})
    return result.status, result.x / unknown, result.deviation / unknown, len(result.unseen)


@pytest.mark.thorough
@pytest.mark.parametrize("deviation", [True, False])
@pytest.mark.parametrize("start", [0.0, 1e-12])
def test_units(deviation, start):
    status, x, deviations, unseen = fitted(1.0, 1.0, deviation, start)
    assert (status, unseen) == ("converged", 0)
    assert (np.abs(x - [3.0, 1.3, 0.2]) < 4.0 * deviations).all()
    for data in UNITS:
        for unknown in UNITS:
            other = fitted(data, unknown, deviation, start)
            assert (other[0], other[3]) == (status, unseen)
            assert (np.abs(other[1] - x) < 1e-3 * deviations).all()
            np.testing.assert_allclose(other[2], deviations, rtol=1e-3)


def test_a_constant_that_an_offset_takes():
    """The offset takes the constant; all else stays, with its deviations."""
    _, x, deviations, _ = fitted(1.0, 1.0, False)
    for constant in (-1e3, 10.0, 1e6):
        status, other, others, _ = fitted(1.0, 1.0, False, constant=constant)
        assert status == "converged"
        assert (np.abs(other - x - [0.0, 0.0, constant]) < 2e-3 * deviations).all()
        np.testing.assert_allclose(others, deviations, rtol=1e-3)
