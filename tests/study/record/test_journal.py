"""What a study tells its tracker of failures and of the best design: counts are counts, and the best is feasible."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console

from torchmbd.optimization import Evaluation, Iterate, MultistartResult, OptimizationResult
from torchmbd.study.record.journal import Journal
from torchmbd.study.record.run_record import child
from torchmbd.study.record.unfinished import PARENT
from torchmbd.study.run import _summarize

X = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])


class Heard:
    """A tracker that keeps the metrics [(step, value)] and tags of every run."""

    def __init__(self) -> None:
        self.points: dict[tuple[str, str], list[tuple[int, float]]] = defaultdict(list)
        self.words: dict[str, dict[str, str]] = defaultdict(dict)

    def metrics(self, run, values, step=0):
        for key, value in values.items():
            self.points[run, key].append((step, value))

    def tags(self, run, values):
        self.words[run] |= values

    def end(self, run, status):
        self.words[run] |= {"run": status}


@pytest.fixture
def heard():
    columns = SimpleNamespace(
        by_name=lambda x: {"angle_1_deg": float(x[0])}, sentence=lambda x: f"{x[0]:g}", names=["a"], labels=()
    )
    journal = Journal(
        cast(Any, SimpleNamespace(columns=columns, sign=1.0, feasibility=1e-6)), Console(quiet=True), cast(Any, Heard())
    )
    return journal, cast(Any, journal.tracker)


def iterate(number: int, objective: float, violation: float, status: str = "ok") -> Iterate:
    known = {"x": X[0], "objective": objective, "violation": violation, "iteration": number, "status": status}
    known |= {"constraints": np.array([violation]), "analyses": 1, "start": 0, "accuracy": ""}
    return Iterate(**{field.name: known.get(field.name) for field in dataclasses.fields(Iterate)})


def ended(value: float, violation: float, status: str = "converged", start: int = 0, failures: int = 0):
    known = {"x": X[0], "value": value, "violation": violation, "status": status, "start": start, "failures": failures}
    known |= {"message": "", "method": "", "iterations": 2, "analyses": 3, "history": [], "constraints": np.zeros(1)}
    known |= {"multipliers": np.zeros(1), "bound_multipliers": np.zeros(2), "names": ["a", "b"], "feasibility": 1e-6}
    known["reasons"] = {"failed: no": failures} if failures else {}
    return OptimizationResult(**{field.name: known.get(field.name) for field in dataclasses.fields(OptimizationResult)})


def test_failed_evaluations_are_counted(heard):
    journal, tracker = heard
    journal.evaluated(X[:2], [Evaluation(1.0, np.zeros(1)), Evaluation.failure("failed: no", 1)])
    journal.evaluated(X[1:], [Evaluation.failure("failed: never", 1), Evaluation.failure("failed: not yet", 1)])
    journal.evaluated(X[:1], [Evaluation(1.0, np.zeros(1))])
    assert tracker.points[PARENT, "search/evaluations"] == [(2, 2), (4, 4), (5, 5)]
    assert tracker.points[PARENT, "search/failed_evaluations"] == [(2, 1), (4, 3), (5, 3)]
    assert tracker.words[PARENT]["last_failure"] == "failed: not yet (design 0.5)"


def test_failed_evaluations_of_a_start_are_counted(heard):
    journal, tracker = heard
    journal.result(ended(2.0, 0.0, failures=3))
    assert [value for _, value in tracker.points[child(0), "search/failed_evaluations"]] == [3]


def test_an_infeasible_or_failed_iterate_is_not_the_best(heard):
    journal, tracker = heard
    for number, (objective, violation, status) in enumerate(
        [
            (9.0, 0.0, "ok"),
            (1.0, 0.5, "ok"),
            (2.0, 2e-6, "ok"),
            (3.0, 0.0, "failed: no"),
            (5.0, 1e-7, "ok"),
            (7.0, 0.0, "ok"),
        ]
    ):
        journal.iterate(iterate(number, objective, violation, status))
    assert [value for _, value in tracker.points[PARENT, "best_objective"]] == [9.0, 5.0]


@pytest.mark.parametrize(
    ("results", "best"),
    [
        ([ended(1.0, 0.5), ended(3.0, 0.0, start=1), ended(4.0, 0.0, start=2)], 3.0),
        ([ended(1.0, 0.0, "infeasible"), ended(0.5, 0.0, "failed", 1), ended(4.0, 0.0, start=2)], 4.0),
        ([ended(1.0, 0.5), ended(2.0, 1e-3, start=1)], None),
    ],
)
def test_the_best_of_a_study_is_feasible(heard, results, best):
    journal, tracker = heard
    study = MultistartResult(results, [])
    assert (None if study.best is None else study.best.value) == best
    journal.first[0] = 8.0
    _summarize(study, journal)
    assert [value for _, value in tracker.points[PARENT, "best_objective"]] == ([] if best is None else [best])
