"""A sweep: objective and constraints along one design variable, evaluated together (Fig. 8).

Other variables keep their start values. All values are divided by the size of those of the start design, which is
evaluated too; where this is zero, values remain as they are. The best point is the lowest that satisfies all constraints.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.design import Problem
from torchmbd.design.problem_parts import responses_of
from torchmbd.design.words import words
from torchmbd.optimization import Evaluation
from torchmbd.optimization.optimizer import largest_violation, rank
from torchmbd.study.record.journal import Journal, percent
from torchmbd.study.record.metric_names import gain_metric
from torchmbd.study.record.run_record import child
from torchmbd.study.report.progress import drop_order, print_table, shown_rows, table_of
from torchmbd.study.report.terminal import save_figure, write_points
from torchmbd.study.settings import StudySettings
from torchmbd.tracking import Status
from torchmbd.viz import criterion
from torchmbd.viz.panels import SIGNS

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_PART = 512  # designs at most in a part of the sweep, which is on disk before the next begins


@dataclass(frozen=True)
class SweepResult:
    """The points of a sweep, in the units of the study.

    heading     of the swept variable, with its unit
    start       value of the swept variable of the start design
    values      of the swept variable [points]
    criteria    name -> objective or constrained response, divided by its size at the start design [points]; nan: failed
    designs     name -> design variable [points]
    objectives  as the question states them [points]
    violations  the largest of a constraint [points]
    statuses    "ok", or why a point failed [points]
    """

    heading: str
    start: float
    values: np.ndarray
    criteria: dict[str, list[float]]
    designs: dict[str, list[float]]
    objectives: list[float]
    violations: list[float]
    statuses: list[str]

    def to_dataframe(self) -> DataFrame:
        """A row for each point: design by its names, objective, violation, status, criteria divided by those of the start."""
        import pandas as pd

        outcome = {"objective": self.objectives, "violation": self.violations, "status": self.statuses}
        ratios = {f"{name} / start": ratio for name, ratio in self.criteria.items()}
        return pd.DataFrame(self.designs | outcome | ratios).rename_axis("point")

    def plot(self) -> Figure:
        """Figure of the criteria against the swept variable."""
        return criterion(values=self.values, criteria=self.criteria, xlabel=self.heading, mark=self.start)


def run_sweep(
    study: StudySettings,
    problem: Problem,
    evaluate: Callable[[np.ndarray, bool], list[Evaluation]],
    journal: Journal,
    console: Console,
) -> tuple[SweepResult | None, Status]:
    """Evaluate the sweep, draw it, and track every point as a child run; None if the start cannot be evaluated."""
    assert study.sweep is not None
    index, swept = study.sweep
    values = swept / study.columns.factors[index]
    X = np.tile(problem.start, (len(swept), 1))
    X[:, index] = swept
    journal.begin_study()
    with console.status(f"{escape(study.name)}: {len(swept)} designs"):
        designs = np.vstack([problem.start, X])
        parts = np.array_split(designs, math.ceil(len(designs) / _PART))
        evaluations = [evaluation for part in parts for evaluation in evaluate(part, False)]
        first, *evaluations = [_largest_row(problem, x, e) for x, e in zip(designs, evaluations, strict=True)]
    if first.status != "ok":
        console.print(f"The start design cannot be evaluated: {escape(first.status)}", style="red", soft_wrap=True)
        return None, "FAILED"
    for k, (x, evaluation) in enumerate(zip(X, evaluations, strict=True)):
        _file_point(journal, k, x, evaluation, first)
    criteria = _criteria(problem, first, evaluations)
    violations = [largest_violation(e.constraints, _equality(problem, e)) for e in evaluations]
    evaluated = [k for k, e in enumerate(evaluations) if e.status == "ok"]
    nearest = min(
        evaluated, default=None, key=lambda k: rank(evaluations[k].objective, violations[k], study.feasibility)
    )
    best = nearest if nearest is not None and violations[nearest] <= study.feasibility else None
    start = float(problem.start[index] / study.columns.factors[index])
    result = SweepResult(
        study.columns.heading(index),
        start,
        values,
        criteria,
        {name: x.tolist() for name, x in zip(study.columns.names, study.columns.in_units(X).T, strict=True)},
        [study.sign * e.objective for e in evaluations],
        [violation if e.status == "ok" else math.nan for violation, e in zip(violations, evaluations, strict=True)],
        [e.status for e in evaluations],
    )
    _show(study, journal, console, index, result, best)
    if nearest is None:
        return result, "FAILED"
    if best is None:
        reason = (
            f"no point satisfies all constraints; the nearest, {nearest}, is beyond one by {violations[nearest]:.3g}"
        )
        journal.summary({"violation": violations[nearest]}, {"message": reason})
        console.print(f"No design to report: {reason}", soft_wrap=True, highlight=False, markup=False)
        return result, "FINISHED"
    value = study.sign * evaluations[best].objective
    numbers = {"objective": value, "best_objective": value}
    numbers[gain_metric(study.sign)] = percent(first.objective, evaluations[best].objective)
    journal.summary(numbers | journal.design_metrics(X[best]), {"best_point": str(best)})
    journal.design(X[best])
    return result, "FINISHED"


def _file_point(journal: Journal, k: int, x: np.ndarray, evaluation: Evaluation, first: Evaluation) -> None:
    journal.begin_start(k, x, kind="point")
    numbers = journal.design_metrics(x)
    if evaluation.status == "ok":
        numbers |= {
            "objective": journal.study.sign * evaluation.objective,
            "ratio": journal.study.sign * evaluation.objective / (abs(first.objective) or 1.0),
        }
        numbers |= journal.constraints(evaluation.constraints)
    else:
        journal.tracker.tags(child(k), {"last_failure": evaluation.status})
    journal.tracker.metrics(child(k), numbers)
    journal.tracker.end(child(k), "FINISHED" if evaluation.status == "ok" else "FAILED")


def _criteria(problem: Problem, first: Evaluation, evaluations: list[Evaluation]) -> dict[str, list[float]]:
    """Return objective and constrained responses by name, divided by their size at the start design; nan: failed.

    Of a constraint of several rows it is the row nearest to its limit or farthest beyond.
    """
    measures = [problem.stated_objective, *(constraint.measure for constraint in problem.constraints)]
    bodies = len({words(m).removeprefix(words(m, bodies=False)) for m in measures}) > 1  # name the bodies if several
    name = words(problem.stated_objective, bodies)
    result = {name: _ratios([problem.sign * e.objective for e in (first, *evaluations)])}
    missing = np.full(first.constraints.size, np.nan)
    scaled = np.array([e.constraints if e.status == "ok" else missing for e in (first, *evaluations)])[
        :, problem.peaks :
    ]
    responses = responses_of(problem.constraints, problem.constraint_rows, problem.reference, scaled)
    for constraint, values in zip(problem.constraints, responses, strict=True):
        name, ratios = words(constraint.measure, bodies), _ratios(values.tolist())
        if name in result and not np.array_equal(result[name], ratios, equal_nan=True):  # another row of it
            name = f"{name} {SIGNS[constraint.kind]}"
        result.setdefault(name, ratios)
    return result


def _ratios(values: list[float]) -> list[float]:
    """Return values but the first, divided by the size of the first; as they are where it is zero."""
    size = abs(values[0]) or 1.0
    return [value / size for value in values[1:]]


def _largest_row(problem: Problem, x: np.ndarray, evaluation: Evaluation) -> Evaluation:
    """Return the evaluation of a design; of a min-max problem with the largest row as objective, also beyond the start's."""
    if not problem.has_extra_variable:
        return evaluation
    return replace(problem.reference.extra, upper=np.inf).tightened(x, evaluation)[1]


def _equality(problem: Problem, evaluation: Evaluation) -> np.ndarray:
    """Return which rows of the constraints are equalities [m]."""
    return np.isin(np.arange(evaluation.constraints.size), problem.equalities)


def _show(
    study: StudySettings,
    journal: Journal,
    console: Console,
    index: int,
    result: SweepResult,
    best: int | None,
) -> None:
    heading, values, criteria = result.heading, result.values, result.criteria
    table = table_of(f"{study.name}: criteria divided by their sizes at the start design", [heading, *criteria])
    rows = shown_rows(len(values), best)
    for k, value in ((k, values[k]) for k in rows):
        cells = [f"{ratios[k]:.4f}" if math.isfinite(ratios[k]) else "failed" for ratios in criteria.values()]
        table.add_row(f"{value:.2f}", *cells, style="bold" if k == best else None)
    print_table(table, console, drop_order(2, len(criteria) - 1))
    points = list(zip(values.tolist(), *criteria.values(), strict=True))
    write_points("sweep.csv", [study.columns.names[index], *criteria], points, len(rows), journal, console)
    if np.isfinite(next(iter(criteria.values()))).any():
        files = ["sweep.png", "sweep.pdf"]
        save_figure(result.plot, files, journal, console)
