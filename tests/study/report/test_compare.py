"""Studies side by side on the terminal."""

from __future__ import annotations

import io
import re
import shutil

import pytest
from rich.console import Console

from tests.refused import refused
from torchmbd.study.record.metric_names import DESIGN
from torchmbd.study.record.run_record import flat
from torchmbd.study.report.compare import differences, outcomes, print_best, print_comparison
from torchmbd.study.report.listing import print_links_of
from torchmbd.tracking.catalog import children, find
from torchmbd.tracking.mlflow_tracker import MlflowTracker

pytestmark = pytest.mark.thorough


def shown(function, *arguments):
    output = io.StringIO()
    function(*arguments, Console(file=output, width=120))
    return output.getvalue()


def test_only_what_differs_is_compared(finished):
    first, second = (find(finished.uri, run) for run in finished.runs)
    assert differences(first, second) == [
        ("simulate.steps", "8", "10"),
        ("overrides", "simulate.duration=0.002 simulate.steps=8", "simulate.duration=0.002 simulate.steps=10"),
    ]
    text = shown(print_comparison, *finished.runs, finished.uri)
    (row,) = [line.split() for line in text.splitlines() if "best_objective" in line]
    assert row[1:] == [f"{entry.metrics['best_objective']:.6g}" for entry in (first, second)]


def test_a_run_is_not_compared_with_itself(finished):
    run = finished.runs[0]
    with refused("a", run):
        shown(print_comparison, run, run[:8], finished.uri)


def test_design_variables_of_either_run_are_compared():
    first, second = {"best_objective": 1.0, f"{DESIGN}angle": 3.0}, {f"{DESIGN}thickness": 2.0, "violation": 0.0}
    for runs in ((first, second), (second, first)):
        assert set(outcomes(*runs)) == {"best_objective", "violation", f"{DESIGN}angle", f"{DESIGN}thickness"}


def test_the_best_come_first(finished):
    text = shown(print_best, finished.runs[0], finished.uri, 1)
    best = children(finished.uri, find(finished.uri, finished.runs[0]))[0]
    assert f"{best.metrics['objective']:.6g}" in text
    assert f" {best.metrics['design/angle_2_deg']:z.2f} " in text
    assert "[deg]" in text  # the headings of `run`
    assert "angle_2_deg" not in text
    assert sum(line.split()[:2] == ["start", best.name.split()[1]] for line in text.splitlines()) == 1
    assert finished.runs[1][:8] in shown(print_best, None, finished.uri, 5)  # the latest


def test_an_empty_store_says_so(tmp_path):
    assert "No studies yet" in shown(print_best, None, f"sqlite:///{tmp_path}/none.db", 5)


def test_designs_that_violate_a_constraint_come_last(empty_store, folder):
    uri = f"sqlite:///{shutil.copy(empty_store, folder)}"
    tracker = MlflowTracker("order", uri)
    tracker.begin("study", "order", params={}, tags={"kind": "study"})
    for name, objective, violation in (("a", 1.0, 0.2), ("b", 3.0, 0.0), ("c", 2.0, 0.0), ("d", 0.5, 0.4)):
        tracker.begin(name, name, parent="study", params={}, tags={"kind": "start"})
        tracker.metrics(name, {"objective": objective, "violation": violation}, 0)
        tracker.end(name, "FINISHED")
    tracker.end("study", "FINISHED")
    tracker.close()
    run = tracker.record.runs["study"]
    assert [child.name for child in children(uri, find(uri, run))] == ["c", "b", "a", "d"]
    text = shown(print_best, run, uri, 5)
    rows = [line.split() for line in text.splitlines() if line.split()[:1] and line.split()[0] in "abcd"]
    assert [(row[0], row[2]) for row in rows] == [("c", "0"), ("b", "0"), ("a", "2e-01"), ("d", "4e-01")]
    assert "the same mbd.Study" in text  # a study without a model file


def test_lists_of_constraints_are_compared_entry_by_entry():
    limit = {"max": {"strain_energy": "rod"}, "at_most": 2.0}
    params = flat({"subject_to": [limit], "starts": {"points": [[1.0, 2.0]]}})
    assert params["subject_to.0.max.strain_energy"] == "rod"
    assert params["subject_to.0.at_most"] == 2.0
    assert params["starts.points"] == [[1.0, 2.0]]


@pytest.mark.parametrize("width", [60, 80, 400])
def test_links_fit_the_terminal_and_stay_whole(width):
    links = {"table": "http://127.0.0.1:5000/#/" + "x" * 130, "on disk": "mlartifacts/" + "0" * 32}
    terminal, file = io.StringIO(), io.StringIO()
    print_links_of(links, Console(file=terminal, width=width, force_terminal=True))
    print_links_of(links, Console(file=file, width=width))
    shown = re.sub(r"\x1b\[[0-9;]*m|\x1b]8;[^\x1b]*\x1b\\", "", terminal.getvalue())
    assert max(map(len, shown.splitlines())) <= width
    assert f";{links['table']}\x1b" in terminal.getvalue()  # what a click opens
    for link in links.values():
        assert f" {link}\n" in file.getvalue()
