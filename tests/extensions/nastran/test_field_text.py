"""Numbers in large fields: sixteen columns, read again to 1e-10."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchmbd.errors import InputError
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.field_text import card_lines, number_text


@given(st.floats(1e-99, 1e99) | st.floats(-1e99, -1e-99) | st.floats(-1e4, 1e4))
def test_a_number_is_read_again(x):
    text = number_text(x)
    assert len(text) <= 16
    assert "." in text
    assert Card("", (text,), "").real(1, "x") == pytest.approx(x, rel=1e-9, abs=0)


@pytest.mark.parametrize(
    ("x", "text"),
    [
        (0.0, "0."),
        (45.0, "45."),
        (-0.5, "-.5"),
        (1.25e-4, "1.25-4"),
        (128e9, "1.28+11"),
        (1.0 / 3.0, ".333333333333333"),
    ],
)
def test_short_numbers_are_short(x, text):
    assert number_text(x) == text


@pytest.mark.parametrize("x", [math.nan, math.inf])
def test_other_numbers_are_refused(x):
    with pytest.raises(InputError, match=r"a field of a card = (nan|inf): must be a finite number"):
        number_text(x)


def test_lines_come_in_pairs():
    assert card_lines("PCOMP", [7, "", 0.5]) == [
        "PCOMP*  " + "7".rjust(16) + " " * 16 + ".5".rjust(16),
        "*",
    ]
