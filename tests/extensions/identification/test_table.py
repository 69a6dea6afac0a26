"""Tables: units of headings, gaps, faults with their lines, and a long file that is read once."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pandas as pd
import pytest

import torchmbd as mbd
from tests.refused import refused
from torchmbd.extensions.identification.table import Table


def written(folder, text: str):
    file = folder / "run.csv"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_columns_units_and_gaps(tmp_path, separator):
    file = written(tmp_path, "t [ms],tip [mm],other\n0,1.5,a\n1,,b\n2,nan,c\n3,-2e1,d\n".replace(",", separator))
    table = Table.of(file, ["t", "tip"])
    np.testing.assert_array_equal(table.columns["tip"], [1.5, np.nan, np.nan, -20.0])
    assert table.factor("t", None) == (1e-3, "s")
    assert table.factor("tip", "mm") == (1e-3, "m")
    assert table.row(2) == f"{file}, line 4"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x\n0,1\n\n1,1.2.3\n", r"line 4: column 'x' = '1.2.3': must be a number, or an empty field"),
        ("t,x\n0,1\n1,2,3\n", r"line 3: has 3 fields: must have 2"),
        ("t,x\n0,1\n1\n2,3\n", r"line 3: has 1 fields: must have 2 \(an empty field is a gap\)"),
        ("t,x,y\n0,1\n1,2,3,4\n", r"line 2: has 2 fields: must have 3"),  # as many separators as in a good file
        ("t,x\n0,1\n1", r"line 3: has 1 fields: must have 2"),
        ("t,x\n0,1\n1,1_0\n", r"line 3: column 'x' = '1_0'"),
        ("t,y\n0,1\n", r"column = 'x': must be one of t, y"),
        ("t,x,x\n0,1,2\n", r"line 1: headings are .*must have each name once"),
        ("", r"column = 't': must be left out"),
    ],
)
def test_faults_are_named_with_their_lines(tmp_path, text, message):
    with pytest.raises(mbd.InputError, match=message):
        Table.of(written(tmp_path, text), ["t", "x"])


def test_other_data_are_refused():
    for data in (3, None, [1.0, 2.0], "no such file.csv"):
        with refused("data"):
            Table.of(data, ["t"])
    with refused("columns.tip", "tip", meant="top"):
        Table.of({"t": [0.0], "top": [0.0]}, ["t", "tip"])
    with refused("columns"):
        Table.of({"t": [0.0, 1.0], "x": [0.0]}, ["t", "x"])
    with refused("columns.x"):
        Table.of({"t": [0.0, 1.0], "x": ["a", "b"]}, ["t", "x"])
    with refused("columns.x", "millimetre"):
        Table.of({"x [millimetre]": [0.0]}, ["x"]).factor("x", None)
    with refused("columns.x", "m"):
        Table.of({"x [mm]": [0.0]}, ["x"]).factor("x", "m")


def test_arrays_and_frames_are_not_copied():
    x = np.linspace(0.0, 1.0, 1000)
    frame = pd.DataFrame({"x [mm]": x}, copy=False)
    assert np.shares_memory(Table.of({"x": x}, ["x"]).columns["x"], x)
    column = frame["x [mm]"].to_numpy()  # read-only in pandas 3: tensors cannot share it
    assert np.shares_memory(Table.of(frame, ["x"]).columns["x"], column) == column.flags.writeable


@pytest.mark.thorough
def test_a_million_rows_are_read_once(tmp_path):
    """Three columns of 8 MB: peak memory is that of few copies of them, with the rest of the file."""
    t = np.linspace(0.0, 10.0, 1_000_000)
    file = tmp_path / "long.csv"
    pd.DataFrame({"t": t, "x": np.sin(t), "y": np.cos(t)}).to_csv(file, index=False, float_format="%.9g")
    tracemalloc.start()
    series = mbd.identification.TimeSeries(file, {"x": mbd.Position("bob", "x"), "y": mbd.Position("bob", "y")})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [len(block.measured) for block in series.blocks] == [1_000_000] * 2
    assert peak < 4 * 3 * 8e6


def test_lines_longer_than_what_is_read_at_once(tmp_path, monkeypatch):
    """Separators are counted by lines, whatever chunks the file is read in; quotes and empty lines are no faults."""
    monkeypatch.setattr("torchmbd.extensions.identification.table._CHUNK", 3)
    for ending in ("\n", ""):
        file = written(tmp_path, 'time,height\n0.125,1000\n\n0.25,\n0.5,"3000"' + ending)
        np.testing.assert_array_equal(Table.of(file, ["time", "height"]).columns["height"], [1000.0, np.nan, 3000.0])
    with pytest.raises(mbd.InputError, match="line 3: has 1 fields"):
        Table.of(written(tmp_path, "time,height\n0.125,1000\n0.25\n0.5,3000\n"), ["time"])


def test_spaces_after_separators_are_no_part_of_names(tmp_path):
    file = tmp_path / "rig.csv"
    file.write_text("t [ms], tip [mm], other\n0, 1, 7\n1, 2, 8\n")
    table = Table.of(file, ["tip", "t"])
    assert table.columns["tip"].tolist() == [1.0, 2.0]
    assert table.columns["t"].tolist() == [0.0, 1.0]


def test_columns_of_one_name_are_refused():
    with refused("data", {"x [mm]": [1.0], "x [m]": [1.0]}):
        Table.of({"x [mm]": [1.0], "x [m]": [1.0]}, ["x"])
