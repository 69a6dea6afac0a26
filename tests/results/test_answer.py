"""The text of a response with its error."""

from __future__ import annotations

import pytest

from torchmbd.results.answer import Number


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (Number(148.222, 0.0), "148.222"),
        (Number(148.222, -3e-14), "148.222"),  # rounding
        (Number(0.0067, 4e-5), "0.0067 (+4e-05)"),
        (Number(0.0, -3e-14), "0 (-3e-14)"),
        (Number(2.0, 0.5, "half the step changes it"), "2 (+0.5) not resolved"),
    ],
)
def test_a_number_and_its_error(number: Number, text: str) -> None:
    assert str(number) == text
