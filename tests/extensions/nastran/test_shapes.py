"""Closed forms of named sections: against hand calculations, and against the finite elements of our own sections."""

from __future__ import annotations

import math

import pytest

from torchmbd.extensions.nastran.shapes import SHAPES, of_shape, torsion

#: A, I1, I2, I12 by hand: whole rectangle less what is cut out, or parts with their arms.
CASES = {
    "ROD": ([2.0], 4 * math.pi, 4 * math.pi, 4 * math.pi, 0.0),
    "TUBE": ([2.0, 1.5], 1.75 * math.pi, (16 - 5.0625) * math.pi / 4, (16 - 5.0625) * math.pi / 4, 0.0),
    "TUBE2": ([2.0, 0.5], 1.75 * math.pi, (16 - 5.0625) * math.pi / 4, (16 - 5.0625) * math.pi / 4, 0.0),
    "BAR": ([1.0, 3.0], 3.0, 2.25, 0.25, 0.0),
    "BOX": ([4.0, 6.0, 0.2, 0.3], 24 - 3.4 * 5.6, (4 * 216 - 3.4 * 5.6**3) / 12, (6 * 64 - 5.6 * 3.4**3) / 12, 0.0),
    "I1": ([3.0, 0.2, 5.0, 6.0], 4.2, (3.2 * 216 - 3 * 125) / 12, (3.2**3 + 5 * 0.2**3) / 12, 0.0),
    "CHAN1": ([3.0, 0.2, 5.0, 6.0], 4.2, (3.2 * 216 - 3 * 125) / 12, None, 0.0),
    "CHAN": ([3.2, 6.0, 0.2, 0.5], 4.2, (3.2 * 216 - 3 * 125) / 12, None, 0.0),
    "CHAN2": ([0.5, 0.2, 3.2, 6.0], 4.2, None, (3.2 * 216 - 3 * 125) / 12, 0.0),
    "Z": ([3.0, 0.2, 5.0, 6.0], 4.2, (3.2 * 216 - 3 * 125) / 12, None, -2 * 1.5 * 2.75 * 1.6),
    "H": ([3.0, 0.8, 5.0, 0.3], 4.9, (0.8 * 125 + 3 * 0.027) / 12, (5 * 3.8**3 - 4.7 * 27) / 12, 0.0),
    "CROSS": ([3.0, 0.2, 5.0, 0.3], 1.9, (0.2 * 125 + 3 * 0.027) / 12, (0.3 * 3.2**3 + 4.7 * 0.2**3) / 12, 0.0),
    # flange 10 x 1, web 3 x 1, their middles 2 apart
    "T2": ([10.0, 4.0, 1.0, 1.0], 13.0, (10 + 27) / 12 + 30 / 13 * 4, (1000 + 3) / 12, 0.0),
    "T": ([10.0, 4.0, 1.0, 1.0], 13.0, (10 + 27) / 12 + 30 / 13 * 4, (1000 + 3) / 12, 0.0),
    "T1": ([10.0, 3.0, 1.0, 1.0], 13.0, (1000 + 3) / 12, (10 + 27) / 12 + 30 / 13 * 4, 0.0),
    "L": ([4.0, 6.0, 0.3, 0.2], 2.34, None, None, -1.2 * 1.14 / 2.34 * 3.0 * 1.9),
    "I": ([4.0, 10.0, 1e-9, 1.0, 1.0, 1e-9], 13.0, (10 + 27) / 12 + 30 / 13 * 4, (1000 + 3) / 12, 0.0),
    "BOX1": (
        [4.0, 6.0, 0.2, 0.2, 0.3, 0.3],
        24 - 3.4 * 5.6,
        (4 * 216 - 3.4 * 5.6**3) / 12,
        (6 * 64 - 5.6 * 3.4**3) / 12,
        0.0,
    ),
    "HAT": ([5.0, 0.2, 3.0, 1.0], 0.6 + 2 * 4.6 * 0.2 + 2 * 1.2 * 0.2, None, None, 0.0),
    "HEXA": ([1.0, 5.0, 3.0], 12.0, 3 * 27 / 12 + 4 * 1.5**3 / 12, None, 0.0),
}


@pytest.mark.parametrize("kind", CASES)
def test_areas_and_second_moments(kind):
    d, *expected = CASES[kind]
    result = of_shape(kind, d)
    for value, right in zip(result[:4], expected, strict=True):
        if right is not None:
            assert value == pytest.approx(right, rel=1e-6, abs=1e-12)
    assert 0 < result.J < result.I1 + result.I2 + 1e-12
    assert 0 < result.K1 <= 1
    assert 0 < result.K2 <= 1


def test_every_shape_is_tested():
    assert set(CASES) == set(SHAPES)
    assert all(len(CASES[kind][0]) == count for kind, count in SHAPES.items())


def test_torsion():
    """A square: 0.1406 a^4; a thin strip: a b^3 / 3; a thin box: 4 A^2 / (s / t)."""
    assert torsion(2.0, 2.0) == pytest.approx(0.14058 * 16, rel=1e-4)
    assert torsion(100.0, 0.1) == pytest.approx(100 * 1e-3 / 3, rel=1e-3)
    assert pytest.approx(4 * 24**2 / (20 / 0.1)) == of_shape("BOX", [4.1, 6.1, 0.1, 0.1]).J


def test_centers_of_shear():
    """Of a channel 3 b^2 t / (6 b t + h t_w) behind the web; of a T and an L where the middle lines meet."""
    e = 3 * 4**2 * 0.2 / (6 * 4 * 0.2 + 6 * 0.1)
    center = of_shape("CHAN", [4.05, 6.2, 0.1, 0.2]).center
    middle = 2 * 3.95 * 0.2 * 2.025 / (2 * 3.95 * 0.2 + 6.2 * 0.1)  # from the line of the web
    assert center == (pytest.approx(0.0), pytest.approx(middle + e))
    assert of_shape("T2", [10.0, 4.0, 1.0, 1.0]).center == (pytest.approx(2 * 3 / 13), 0.0)
    assert of_shape("I", [6.0, 3.0, 3.0, 0.2, 0.3, 0.3]).center == (pytest.approx(0.0, abs=1e-12), 0.0)
    y, z = of_shape("L", [4.0, 6.0, 0.3, 0.2]).center
    assert (y, z) == (pytest.approx(1.14 * 3.0 / 2.34), pytest.approx(1.2 * 1.9 / 2.34))


@pytest.mark.parametrize(
    ("kind", "d", "word"),
    [
        ("BOX", [1.0, 1.0, 0.6, 0.1], "walls"),
        ("TUBE", [1.0, 1.0], "inner radius"),
        ("I", [1.0, 1.0, 1.0, 0.1, 0.5, 0.6], "webs"),
        ("HEXA", [3.0, 5.0, 1.0], "DIM2"),
        ("BAR", [1.0, -1.0], "> 0"),
    ],
)
def test_measures_that_contradict_each_other(kind, d, word):
    with pytest.raises(ValueError, match=word):
        of_shape(kind, d)
