"""The page "Read the code": its files and names are there, its counts are those of the source, its drawing is up to date."""

from __future__ import annotations

import re

import pytest

from experiments.documentation import code

TEXT = code.PAGE.read_text(encoding="utf-8")


def test_the_page_says_what_the_source_has():
    assert code.faults(TEXT) == [], "counts: python -m experiments.documentation.code"


def test_the_drawing_is_that_of_the_program():
    assert code.DRAWING.read_text(encoding="utf-8") == code.drawing()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("`integrate/step.py`", "`integrate/stride.py`", "integrate/stride.py"),
        ("`Step.residual`", "`Step.rest_of_it`", "rest_of_it"),
        ("**`integrate/step.py`** (206 lines)", "**`integrate/step.py`** (406 lines)", "406 lines on the page"),
    ],
)
def test_a_wrong_name_and_a_wrong_count_are_seen(old, new, said):
    text = re.sub(r"(integrate/step.py`\*\*) \(\d+ lines\)", r"\1 (206 lines)", TEXT)
    assert old in text
    assert any(said in fault for fault in code.faults(text.replace(old, new)))


def test_every_part_is_a_folder_or_file_that_may_be_there():
    parts = [folder for folders in code.PARTS.values() for folder in folders]
    assert len(parts) == len(set(parts))
    table = code.table(TEXT)
    numbers = dict(re.findall(r"^\| ([a-z][^|]+) \| [\d,]+ \| ([\d,]+) \|$", table, re.MULTILINE))
    counts = {part: int(lines.replace(",", "")) for part, lines in numbers.items()}
    read = counts.pop("of it, the files of this page")
    largest = [counts.pop(part) for part in list(counts) if part.startswith("of them, ")]
    assert sum(counts.values()) == 2 * counts["all"]
    assert largest == sorted(largest, reverse=True)
    assert sum(largest) <= counts["extensions"]
    assert read < counts["core"]
