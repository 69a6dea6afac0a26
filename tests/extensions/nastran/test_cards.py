"""Nastran's three field formats say the same; numbers, ranges, continuations, and what is refused with its line."""

import pytest

from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.cards import parse_cards, read_cards

SMALL = """\
PCOMP   7       -.0015          5.E7    TSAI                    SYM     +P1
+P1     1       1.0-3   45.     YES     2       .5-3    -45.    NO
"""
LARGE = """\
PCOMP*  7               -.0015                          5.E7            *P0
*P0     TSAI                                            SYM             *P1
*P1     1               1.0D-3          45.             YES             *P2
*P2     2               .5-3            -45.            NO
"""
FREE = """\
PCOMP,7,-.0015,,5.E7,TSAI,,,SYM
,1,1.0E-3,45.,YES,2,.5-3,-45.,NO
"""


def cards(text: str) -> list[Card]:
    return parse_cards([(f"line {k}", line) for k, line in enumerate(text.splitlines(), start=1)])


@pytest.mark.parametrize("text", [SMALL, LARGE, FREE], ids=["small", "large", "free"])
def test_all_formats_say_the_same(text):
    (card,) = cards(text)
    assert card.name == "PCOMP"
    assert (card.integer(1, "PID"), card.real(2, "Z0"), card.real(3, "NSM", 0.0)) == (7, -0.0015, 0.0)
    assert (card.real(4, "SB"), card.text(5), card.text(8)) == (5e7, "TSAI", "SYM")
    assert [card.integer(9, "MID1"), card.real(10, "T1"), card.real(11, "THETA1")] == [1, 1e-3, 45.0]
    assert [card.integer(13, "MID2"), card.real(14, "T2"), card.real(15, "THETA2")] == [2, 5e-4, -45.0]
    assert len(card.fields) == 16


def test_continuations_after_short_free_lines_start_in_field_nine():
    first, second = cards("SPC1,1,123456\n,4,5\nGRID,1,,0.,1.+2,-2.5-1")
    assert first.fields == ("1", "123456", "", "", "", "", "", "", "4", "5")
    assert [second.real(k, "X") for k in (3, 4, 5)] == [0.0, 100.0, -0.25]
    assert str(second) == "GRID 1 (line 3)"


def test_ranges_and_several_continuations():
    (card,) = cards("SPC1    3       123     1       THRU    5       9       11      12\n        20      21")
    assert card.integers(3, range(1, 100)) == [1, 2, 3, 4, 5, 9, 11, 12, 20, 21]
    assert card.integers(3, {2, 5}) == [1, 2, 5, 9, 11, 12, 20, 21]  # of a range those that exist


def test_a_file_with_comments_case_control_tabs_and_includes(tmp_path):
    (tmp_path / "part.bdf").write_text("GRID\t2\t\t1.\t2.\t3.\n")
    file = tmp_path / "model.bdf"
    file.write_text("SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\n$ a comment\nGRID,1,,0.,0.,0. $ another\n"
                    "INCLUDE 'part.bdf'\nENDDATA\nGRID,9,,0.,0.,0.\n")  # fmt: skip
    result = read_cards(file)
    assert [(card.name, card.fields[0], card.where) for card in result] == [
        ("GRID", "1", "model.bdf, line 6"),
        ("GRID", "2", "part.bdf, line 1"),
    ]
    assert result[1].real(5, "X3") == 3.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("+A,1,2", ["line 1", "continuation without a card"]),
        ("GRID,1,,a,0.,0.", ["GRID 1 (line 1)", "X1 = 'a'", "a number"]),
        ("GRID 1 2 3 4", ["line 1", "columns"]),
        ("SPC1,1,123,1,2,3,4,5,6,7", ["line 1", "'7'", "8 data fields"]),
        ("SPC1,1,123,4.5", ["SPC1 1 (line 1)", "'4.5'"]),
        ("SPC1,1,123,THRU,7", ["SPC1 1 (line 1)", "THRU"]),
    ],
)
def test_what_is_broken_is_named_with_its_line(text, words):
    def read():
        (card,) = cards(text)
        return card.real(3, "X1"), card.integers(3, ())

    with pytest.raises(InputError) as error:
        read()
    assert all(word in str(error.value) for word in words), str(error.value)


def test_files_that_do_not_exist_and_circles(tmp_path):
    with refused("path"):
        read_cards(tmp_path / "none.bdf")
    file = tmp_path / "a.bdf"
    file.write_text("INCLUDE 'a.bdf'\n")
    with refused("a.bdf.INCLUDE", ANY, "circle"):
        read_cards(file)
    file.write_text("INCLUDE 'b.bdf'\n")
    with refused("a.bdf, line 1.INCLUDE", ANY, "b.bdf"):
        read_cards(file)


def test_superelements_are_named(tmp_path):
    file = tmp_path / "model.bdf"
    file.write_text("BEGIN BULK\nGRID,1\nBEGIN SUPER=1\nGRID,1\n")
    with refused("model.bdf, line 3", ANY, "'BEGIN SUPER=1'"):
        read_cards(file)
