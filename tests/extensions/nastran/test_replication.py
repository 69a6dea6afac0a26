"""Cards that repeat the card before them."""

from __future__ import annotations

import pytest

from torchmbd.errors import InputError
from torchmbd.extensions.nastran.cards import parse_cards


def cards(text: str) -> list[tuple[str, ...]]:
    lines = [(f"line {k}", line) for k, line in enumerate(text.splitlines(), start=1)]
    return [(card.name, *card.fields) for card in parse_cards(lines)]


def test_the_example_of_the_manual():
    result = cards("GRID,101,17,1.0,10.5,,17,3456\n=,*(1),=,*(0.2),==\n=(3)")
    assert [card[1] for card in result] == ["101", "102", "103", "104", "105"]
    assert [float(card[3]) for card in result] == pytest.approx([1.0, 1.2, 1.4, 1.6, 1.8])
    assert all(card[4:] == ("10.5", "", "17", "3456") for card in result)


@pytest.mark.parametrize(
    "lines",
    [
        "CQUAD4,1,1,1,2,12,11\n=,*1,=,*1,*1,*1,*1",
        "CQUAD4,1,1,1,2,12,11\nCQUAD4,2,=,*1,*1,*(1),*( 1 )",
        f"{'CQUAD4':8}{'1':8}{'1':8}{'1':8}{'2':8}{'12':8}{'11':8}\n{'=':8}{'*1':8}{'=':8}{'*1':8}{'*1':8}{'*(1)':8}{'*1':8}",
    ],
)
def test_forms(lines):
    assert cards(lines)[1] == ("CQUAD4", "2", "1", "2", "3", "13", "12")


def test_a_continuation_and_other_cards_follow():
    assert cards("SPC1,1,123,5\n=,=,*1,6\n,7\nGRID,1")[1:] == [("SPC1", "1", "124", "6", *[""] * 5, "7"), ("GRID", "1")]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("=,*1", ["line 1", "no card"]),
        ("GRID,1\n=3", ["line 2", "'=3'"]),
        ("GRID,1\n=,*1\n=(x)", ["line 3", "'=(X)'"]),
        ("GRID,1\n=,*1\n=(9999999)", ["line 3"]),
        ("GRID,1\n=,*1.5", ["line 2", "the step of *", "an integer"]),
        ("GRID,1,,1.\n=,*1,,*x", ["line 2", "'x'"]),
        ("SPC1,1,123,1,2,3,4,5\n,6,7\n=,*1", ["line 3", "one line"]),
        ("GRID,1\nCQUAD4,*1", ["line 2", "CQUAD4 repeats GRID 1"]),
        ("SPC1,1,123,1\n,=", ["line 2", "continuation"]),
    ],
)
def test_what_is_refused(text, words):
    with pytest.raises(InputError) as error:
        cards(text)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_an_equation_is_no_card_of_fields():
    assert cards("DEQATN  10      F(A,B,C,D,E,F,G,H,I,J) = A*B\n+       = C\nGRID,1") == [("DEQATN",), ("GRID", "1")]
