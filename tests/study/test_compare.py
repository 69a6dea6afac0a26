"""Studies side by side on the terminal."""

from __future__ import annotations

import io

from rich.console import Console

from torchmbd.study.compare import differences, print_best, print_comparison
from torchmbd.tracking.catalog import children, find


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


def test_the_best_come_first(finished):
    text = shown(print_best, finished.runs[0], finished.uri, 1)
    best = children(finished.uri, find(finished.uri, finished.runs[0]))[0]
    assert f"{best.metrics['objective']:.6g}" in text
    assert f"{best.metrics['design/angle_2_deg']:.3f}" in text
    assert text.count("start ") == 1
    assert finished.runs[1][:8] in shown(print_best, None, finished.uri, 5)  # the latest


def test_an_empty_store_says_so(tmp_path):
    assert "No studies yet" in shown(print_best, None, f"sqlite:///{tmp_path}/none.db", 5)
