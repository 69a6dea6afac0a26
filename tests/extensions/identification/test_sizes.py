"""A wrong unit is told at the start, by its factor."""

from __future__ import annotations

import numpy as np
import pytest

from tests.extensions.identification.closed_form import fit

T = np.linspace(0.0, 2.0, 40)


@pytest.mark.parametrize(
    ("factor", "unit", "words"),
    [
        (
            180.0 / np.pi,
            "rad",
            "57 times larger than those of the model at the start, as numbers in deg that are read as rad",
        ),
        (
            np.pi / 180.0,
            "rad",
            "57 times smaller than those of the model at the start, as numbers in rad that are read as deg",
        ),
        (1000.0, "m", "1,000 times larger than those of the model at the start, as numbers in mm that are read as m"),
        (1e-3, "m", "1,000 times smaller"),
        (300.0, "rad", "300 times larger than those of the model at the start."),
    ],
)
@pytest.mark.parametrize("constant", [0.0, 1e4])
def test_a_wrong_unit_is_told_by_its_factor(factor, unit, words, constant):
    """The start is 20 % off; a constant in data and model changes nothing."""

    def curve(b, t):
        return b["a"] * (3.0 * t).sin() + constant

    start = 1.0 if factor == 300.0 else 0.8
    y = factor * (np.sin(3.0 * T) + constant)
    with pytest.warns(UserWarning, match=f"channel 'y': the measured numbers are {words}"):
        result = fit({"y": (T, y, None, curve)}, {"a": start}, f" [{unit}]")
    assert words in str(result)


def test_a_start_that_is_somewhat_off_is_not_told(recwarn):
    fit({"y": (T, np.sin(3.0 * T), 1e-3, lambda b, t: b["a"] * (3.0 * t).sin())}, {"a": 0.2})
    assert not [x for x in recwarn if "measured numbers" in str(x.message)]


def test_an_unknown_gain_says_nothing_of_sizes(recwarn):
    fit({"y": (T, 100.0 * np.sin(3.0 * T), 1e-3, lambda b, t: b["y.gain"] * (3.0 * t).sin())}, {"y.gain": 1.0})
    assert not [x for x in recwarn if "measured numbers" in str(x.message)]
