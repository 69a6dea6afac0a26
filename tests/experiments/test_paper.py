"""The report of the paper: parts are found once, rows tell their ratio, the page is whole. Coarse models."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchmbd as mbd
from experiments.models.sar_antenna_data import ANGLES
from experiments.models.sar_antenna_whole import whole
from experiments.paper import antenna, antenna_deployed, parts, report, rod
from experiments.paper.part import Part, Row, find
from tests.refused import refused
from torchmbd.viz.figures import figure_of

pytestmark = pytest.mark.usefixtures("compiled")


def draw(folder: Path, times: int) -> list[Row]:
    (folder / "called").open("a").write("x")
    figure, _ = figure_of(2.0)
    for number in (10, 9):
        mbd.viz.save(figure, folder / f"figure{number}.png")
    return [Row("a < b", 2.0, 3.0 * times, "given"), Row("words", "some", "others", "chosen", "why")]


@pytest.fixture
def part():
    return Part("one", "Fig. 9", draw, ("experiments.paper.rod",), 0.1, {"times": 1})


def test_a_part_is_found_once(part, tmp_path):
    first, second = find(part, tmp_path), find(part, tmp_path)
    assert (first.kept, second.kept) == (False, True)
    assert first.rows == second.rows
    assert [file.name for file in second.figures] == ["figure9.png", "figure10.png"]
    assert not find(part, tmp_path, fresh=True).kept


def test_other_settings_and_half_a_part_are_found_again(part, tmp_path):
    find(part, tmp_path)
    assert not find(replace(part, settings={"times": 2}), tmp_path).kept
    (tmp_path / "one" / part.key / "rows.json").unlink()
    assert not find(part, tmp_path).kept


def test_ratios_and_labels():
    assert Row("x", 4.0, 5.0, "given").ratio == 1.25
    assert Row("x", None, 5.0, "given").ratio is None
    assert Row("x", "7 to 8", 5.0, "given").ratio is None
    with pytest.raises(mbd.InputError, match="label of 'x' = 'guessed': must be one of given, inferred, chosen"):
        Row("x", 4.0, 5.0, "guessed")


def test_the_report_needs_nothing_else(part, tmp_path):
    page = report.write([find(part, tmp_path)], tmp_path / "paper.html").read_text()
    assert "a &lt; b" in page
    assert "1.500" in page
    assert page.count("data:image/png;base64,") == 2
    assert not re.search(r'(src|href)="(?!data:|#)', page)


def test_names_are_checked():
    assert [part.name for part in parts.chosen(["table3", "table2"])] == ["table3", "table2"]
    assert all(part.minutes <= parts.LONG for part in parts.chosen())
    with refused("part", "table33"):
        parts.chosen(["table33"])


def test_every_table_and_figure_with_numbers_has_its_part():
    titles = " ".join(part.title for part in parts.PARTS)
    ranges = re.findall(r"(Tables?|Figs?\.)((?: \d+(?:-\d+)?,?)+)", titles)
    covered: dict[str, set[int]] = {"T": set(), "F": set()}
    for kind, numbers in ranges:
        for number in re.findall(r"\d+(?:-\d+)?", numbers):
            low, _, high = number.partition("-")
            covered[kind[0]] |= set(range(int(low), int(high or low) + 1))
    assert covered["T"] == set(range(1, 9))
    assert covered["F"] >= set(range(4, 12)) | set(range(15, 27))


def test_laminates_of_the_rod(tmp_path):
    rows = rod.laminates(tmp_path, cells=(4, 2), modes=2, steps=24)
    assert [row.label for row in rows] == ["given", "inferred"] * 3
    assert [row.ratio for row in rows if row.label == "inferred"] == pytest.approx([1.0, 1.13, 1.0], abs=0.15)


@pytest.mark.thorough
def test_the_antenna_optimized(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.paper.antenna_optimum.DURATION", 0.5)
    rows = {row.what: row for row in antenna.optimum(tmp_path, 20, max_iterations=1, modes=2, reduction="vibration")}
    assert rows["Table 7: start (deg)"].ours == rows["Table 7: start (deg)"].paper
    assert rows["Table 8: reduction (%)"].ours > 0.0
    assert {file.name for file in tmp_path.iterdir()} == {f"figure{k}.png" for k in (20, 21, 22, 23)}


@pytest.mark.thorough
def test_deployment_of_both_designs(tmp_path):
    rows = {row.what: row for row in antenna.deployment(tmp_path, rate=10, modes=4, cells=(16, 8))}
    assert {file.name for file in tmp_path.iterdir()} == {f"figure{k}.png" for k in (24, 25, 26)}
    assert 7.0 < rows["Fig. 26: theta = 0, initial (s)"].ours < rows["Fig. 26: theta = 0, optimum (s)"].ours < 9.0


def test_lay_ups_as_the_paper_prints_them():
    assert rod.angles([45.0, -18.6, -0.0001]) == "45/-18.6/0"
    assert antenna.stack("lay-up 2") == "0/90/90/0"


def test_figures_go_to_the_tracker(part, tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "PARTS", (part,))
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / "store"))
    folder = tmp_path / "run"
    folder.mkdir()
    result = parts.figures(folder)
    assert result == {"one/a _ b": 1.5, "sentence": result["sentence"]}
    assert {file.name for file in folder.iterdir()} == {"paper.html", "figure9.png", "figure10.png"}


@pytest.mark.thorough
def test_rows_of_both_phases(tmp_path, monkeypatch):
    """Of the first moment of them: the figures, three designs, distances in degrees and millimeters."""

    def shortly(designs, steps, trusses):
        start = mbd.Phase(release=["L7", "L8", "L11", "L12"])
        lanes = {ANGLES: torch.stack([mbd.deg(list(x)) for x in designs])}
        system = whole(designs[0], modes=2, cells=(16, 8), trusses=trusses)
        motions.append(mbd.simulate(system, 0.05, steps=steps, phases=[start], designs=lanes, iterations=(5, 1)))
        return motions[-1]

    motions = []
    monkeypatch.setattr(antenna_deployed, "deployed", shortly)
    rows = {row.what: row for row in antenna_deployed.flexible(tmp_path, 5)}
    assert {file.name for file in tmp_path.iterdir()} == {f"figure{k}_both phases.png" for k in (22, 23, 24, 25, 26)}
    assert rows["both phases, optimum"].ours == "deploys"
    assert rows["mean angle of panels 1 and 2 at the end, initial (deg)"].ours == pytest.approx(
        math.degrees(3.0), abs=0.01
    )
    assert rows["Fig. 22: peak energy of panel2, initial, both phases"].ours < 1e-15  # nothing has reached it yet
    initial, _, optimum = motions[-1].body("panel3").strain_energy.amax(1).tolist()
    result = rows["Fig. 23: peak energy of panel3, optimum over initial"].ours
    assert result == pytest.approx(optimum / initial, rel=0.05)  # of a curve through the points
    first, *_ = rows["least gap, panel 2 - panel 3, initial, paper's optimum, optimum (mm)"].ours.split(", ")
    assert float(first) > 0.0
