"""Large and hostile files: a wrong field among 50,000 lines, huge ranges, circles, paths outside, in bounded memory."""

from __future__ import annotations

import time
import tracemalloc

import pytest

from torchmbd.errors import InputError
from torchmbd.extensions.nastran.body import bulk_body


def large(n: int = 157) -> list[str]:
    """About 50,000 lines: n x n cells."""
    lines = ["BEGIN BULK", "MAT1,1,70.+9,,.3,2700.", "PSHELL,1,1,.01,1"]
    lines += [f"GRID,{1000 * i + j},,{i * 0.01:.3f},{j * 0.01:.3f},0." for i in range(n + 1) for j in range(n + 1)]
    for i in range(n):
        for j in range(n):
            a = 1000 * i + j
            lines.append(f"CQUAD4,{n * i + j + 1},1,{a},{a + 1000},{a + 1001},{a + 1}")
    return lines


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "GRID,100050,,1.000,",
            "GRID,100050,,1.0.0,",
            ["GRID 100050 (model.bdf, line 15854)", "X1", "'1.0.0'", "a number"],
        ),
        (
            "CQUAD4,20000,1,",
            "CQUAD4,20000,1.5,",
            ["CQUAD4 20000 (model.bdf, line 44967)", "PID", "'1.5'", "an integer"],
        ),
        ("CQUAD4,20000,1,", "CQUAD4,20000,7,", ["CQUAD4 20000 (model.bdf, line 44967)", "property 7 does not exist"]),
    ],
)
def test_one_wrong_field_in_50000_lines(old, new, words, tmp_path):
    """It is named by file, line, card, field and value within seconds."""
    text = "\n".join(large())
    assert old in text
    path = tmp_path / "model.bdf"
    path.write_text(text.replace(old, new, 1))
    began = time.process_time()
    with pytest.raises(InputError) as error:
        bulk_body(path)
    assert time.process_time() - began < 10.0
    assert all(word in str(error.value) for word in words), str(error.value)


SMALL = (
    "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nGRID,3,,1.,1.,0.\nCTRIA3,1,1,1,2,3\nPSHELL,1,1,.01,1\nMAT1,1,7.+10,,.3,2700.\n"
)
RANGES = "\n".join(f"SPC1,{k},123456,1,THRU,999999999999" for k in range(1000))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (SMALL + RANGES + "\nGRID,1", ["GRID 1", "appears twice"]),
        (SMALL + "RBE2,7,1,123,2,THRU,999999999999\nRBE2,8,1,123,2", ["GRID 2", "RBE2 7"]),
        (SMALL + "GRID,999999999,,1.,0.,0.\nCTRIA3,2,1,1,2,1000000000", ["CTRIA3 2", "GRID 1000000000 does not exist"]),
        (SMALL + "GRID,99999999999999999999,,1.,0.,0.", ["ID = ", "an integer"]),
        ("INCLUDE 'model.bdf'", ["circle"]),
        ("INCLUDE '../secret.bdf'", ["outside of"]),
        ("INCLUDE '/etc/hostname'", ["model.bdf, line 1"]),
        ("GRID," + "1" * 20_000, ["line 1", "characters"]),
        ("INCLUDE 'model", ["no closing quote"]),
    ],
    ids=lambda given: given[:30] if isinstance(given, str) else "",
)
def test_hostile_files(text, words, tmp_path):
    """Each is refused by name, within a few megabytes."""
    folder = tmp_path / "deck"
    folder.mkdir()
    (tmp_path / "secret.bdf").write_text(SMALL)
    (folder / "model.bdf").write_text(text)
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as error:
            bulk_body(folder / "model.bdf")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert all(word in str(error.value) for word in words), str(error.value)
    assert peak < 20e6
