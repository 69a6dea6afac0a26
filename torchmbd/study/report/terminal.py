"""The report of a study on the terminal, and its pictures."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.design import Problem
from torchmbd.design.ply_failure import PlyFailure
from torchmbd.design.response import Measure
from torchmbd.design.scenarios import Scenarios
from torchmbd.design.words import heading
from torchmbd.optimization import MultistartResult, OptimizationResult
from torchmbd.registry import Registry
from torchmbd.study.record.journal import Journal
from torchmbd.study.report.compare import Start, print_starts
from torchmbd.study.report.progress import ROWS
from torchmbd.study.settings import StudySettings
from torchmbd.summary import few, plural
from torchmbd.viz import (
    animate,
    convergence,
    criteria_over_iterations,
    criteria_over_time,
    design_map,
    failure_map,
    parallel_coordinates,
    save,
    weighted_parts,
)
from torchmbd.viz.panels import histories_of

#: (measures, motion of the start and the best design, labels of both, title, function that saves a figure, folder) -> pages.
DRAWINGS: Registry[Callable[..., list[Any]]] = Registry("drawings", {})


def print_results(study: StudySettings, outcome: MultistartResult, journal: Journal, console: Console) -> None:
    """Print a table of the starts, the best first, what the searches did, and the failed evaluations."""
    if not outcome.results:
        console.print("No start came to a result.")
        return
    best, failures = outcome.best, journal.failures
    ranked = sorted(outcome.results, key=lambda r: (not r.violation <= study.feasibility, r.value))
    shown = [Start(str(r.start), journal.last_numbers(r), r.status, r is best) for r in ranked[:ROWS]]
    title = f"{study.name}: {plural(len(outcome.results), 'start')}, {outcome.converged} converged"
    if not print_starts(title, shown, study.sign, console, "start") and best is not None:
        console.print(f"best design: {study.columns.named(best.x)}", soft_wrap=True, highlight=False)
    if len(ranked) > ROWS:
        console.print(f"the best {ROWS} of {len(ranked)} starts; torchmbd best --count {len(ranked)} prints all")
    told: Any = {"soft_wrap": True, "highlight": False, "markup": False}
    verified = isinstance(study.simulated, Problem) and best is not None and not outcome.interrupted
    if not verified:  # a verification tells it
        console.print(outcome.search_text, style="red" if outcome.failing_text else None, **told)
    if best is not None:
        console.print(f"active: {active_text(best)}", **told)
    if failures:
        console.print(f"{len(failures)} failed evaluations; the last: {failures[-1]}", **told)


def active_text(result: OptimizationResult) -> str:
    """Return the names of the constraints and bounds that hold a design."""
    return few(result.active) if result.active else "no constraint and no bound"


_SHOWN = 6  # design variables in a legend, at most

Evaluated = tuple[np.ndarray, np.ndarray]  # designs [m, n], objectives [m]


def save_pictures(
    study: StudySettings, outcome: MultistartResult, evaluated: Evaluated, journal: Journal, console: Console
) -> None:
    """Draw and track the pictures of a study: responses over iterations and time, start and best design, all starts."""
    searches = {f"start {r.start}": r.history for r in outcome.results if r.history}
    if not searches or not any(np.isfinite(r.value) for r in outcome.results):  # nothing could be evaluated
        return
    best, problem = outcome.best, study.simulated
    objective = heading(problem.stated_objective) if isinstance(problem, Problem) else "objective"
    chosen, title = None if best is None else f"start {best.start}", study.question or study.name
    save_figure(
        convergence,
        ["convergence.png"],
        journal,
        console,
        objectives={name: [study.sign * i.objective for i in history] for name, history in searches.items()},
        violations={name: [i.violation for i in history] for name, history in searches.items()},
        best=chosen,
        ylabel=objective,
    )
    save_figure(
        design_map, ["design_map.png"], journal, console, **_map_arguments(study, outcome, evaluated, objective)
    )
    save_figure(
        parallel_coordinates,
        ["parallel_coordinates.png"],
        journal,
        console,
        **_coordinate_arguments(study, outcome, objective),
        title=title,
    )
    if (
        isinstance(problem, Problem) and study.problem is problem
    ):  # over tolerances the numbers are those of many designs
        arguments = {"problem": problem, "searches": searches, "best": chosen, "title": title}
        save_figure(criteria_over_iterations, _png_and_pdf("criteria_over_iterations"), journal, console, **arguments)
    with missing_picture_reported(console):
        # After an interruption nothing more is simulated.
        if best is not None and not outcome.interrupted and isinstance(problem, Problem):
            _motion_pictures(study, np.stack([problem.start, best.x[: len(problem.start)]]), problem, journal, console)


def _png_and_pdf(name: str) -> list[str]:
    """Return the names of a picture for browsers and for print."""
    return [f"{name}.png", f"{name}.pdf"]


def save_figure(
    figure: Callable[..., Any], files: Sequence[str], journal: Journal, console: Console, **arguments: Any
) -> None:
    """Draw a figure of torchmbd.viz and track it under each name; print why it is missing."""
    try:
        drawn = figure(**arguments)
        if drawn is None:  # the problem has nothing of this kind
            return
        for name in files:
            journal.file(save(drawn, journal.folder / name), "figures")
            # Further files have the layout of the first, which takes a third of the time.
            drawn.set_layout_engine("none")
    except Exception as error:  # of matplotlib or the disk: the study goes on without the picture
        console.print(f"No picture: {escape(str(error) or type(error).__name__)}", style="red", soft_wrap=True)


@contextmanager
def missing_picture_reported(console: Console) -> Iterator[None]:
    """Print why a picture is missing (a motion that fails, a full disk), and go on: the numbers of the study are on record."""
    try:
        yield
    except Exception as error:
        console.print(f"No picture: {escape(str(error) or type(error).__name__)}", style="red", soft_wrap=True)


def write_points(
    name: str, headings: Sequence[str], points: Sequence[Sequence[Any]], shown: int, journal: Journal, console: Console
) -> None:
    """Write the points of a front or a sweep, a row for each, to a CSV file of the run; say so if not all are shown."""
    if shown < len(points):
        console.print(f"{shown} of {len(points)} points; all are in {name}, among the files of the run")
    with missing_picture_reported(console):
        with (journal.folder / name).open("w", newline="", encoding="utf-8") as out:
            csv.writer(out).writerows([headings, *points])
        journal.file(journal.folder / name)


def _map_arguments(
    study: StudySettings, outcome: MultistartResult, evaluated: Evaluated, objective: str
) -> dict[str, Any]:
    """Return the arguments of `design_map`: the paths of the starts, and the minimum in which each ended."""
    columns = study.columns
    moved = [result for result in outcome.results if result.history]
    ends = {f"start {start}": k for k, minimum in enumerate(outcome.minima) for start in minimum.starts}
    # Not with an extra variable: the objectives on disk are not the largest rows, nor the worst case.
    seen = None if study.has_extra_variable else (columns.in_units(evaluated[0]), study.sign * evaluated[1])
    return {
        "paths": {f"start {r.start}": columns.in_units(np.array([i.x for i in r.history])) for r in moved},
        "objectives": {f"start {r.start}": [study.sign * i.objective for i in r.history] for r in moved},
        "headings": columns.headings,
        "ends": ends,
        "visited": seen,
        "objective": objective,
    }


def _coordinate_arguments(study: StudySettings, outcome: MultistartResult, objective: str) -> dict[str, Any]:
    """Return the arguments of `parallel_coordinates`: the final designs of the starts."""
    ended = [result for result in outcome.results if np.isfinite(result.value)]
    columns = study.columns
    return {
        "designs": columns.in_units(np.array([result.x for result in ended]).reshape(-1, len(study.problem.start))),
        "objectives": [study.sign * result.value for result in ended],
        "largest": study.sign < 0.0,
        "headings": columns.headings,
        "feasible": [result.violation <= study.feasibility for result in ended],
        "bounds": (columns.in_units(study.problem.lower), columns.in_units(study.problem.upper)),
        "objective": objective,
    }


def _motion_pictures(
    study: StudySettings, designs: np.ndarray, problem: Problem, journal: Journal, console: Console
) -> None:
    title = study.question or study.name
    if isinstance(problem, Scenarios):
        scenario = problem.largest(designs[-1])
        motion = problem.simulate(designs, scenario=scenario).require_ok()
        title += f" (scenario {scenario})"  # the best design is worst there
    else:
        motion = problem.simulate(designs).require_ok()
    labels = ["start design", "best design"]
    if designs.shape[1] <= _SHOWN:
        labels = [f"{label} ({study.columns.sentence(x)})" for label, x in zip(labels, designs, strict=True)]
    arguments = {"motion": motion, "labels": labels, "title": title}
    save_figure(criteria_over_time, _png_and_pdf("criteria_over_time"), journal, console, problem=problem, **arguments)
    save_figure(weighted_parts, _png_and_pdf("weighted_parts"), journal, console, problem=problem, **arguments)
    measures = [problem.objective, *(constraint.measure for constraint in problem.constraints)]
    indices = [
        history for measure in measures for history, _ in histories_of(measure) if isinstance(history, PlyFailure)
    ]
    for body, criterion in dict.fromkeys((index.body, index.criterion) for index in indices):
        name = f"failure_{body}_{criterion}"
        save_figure(failure_map, _png_and_pdf(name), journal, console, body=body, criterion=criterion, **arguments)
    for lane, (name, label) in enumerate(zip(("motion_start", "motion_best"), labels, strict=True)):
        title = f"{study.name}: {label}"
        path = animate(motion, journal.folder / f"{name}.html", lane=lane, title=title, problem=problem)
        journal.file(path)

    def draw(figure: Callable[..., Any], files: Sequence[str], **options: Any) -> None:
        save_figure(figure, files, journal, console, **options)

    for page in draw_measures(problem, motion, labels, study.question or study.name, draw, journal.folder):
        journal.file(page)


def draw_measures(problem: Problem, *arguments: Any) -> list[Any]:
    """Draw the pictures of the measures of a problem (`Measure.drawing`), with arguments as in DRAWINGS; return the pages."""
    by_drawing: dict[str, list[Measure]] = {}
    outer = [problem.stated_objective, *(constraint.measure for constraint in problem.constraints)]
    for measure in _with_operands(*outer):
        if measure.drawing:
            by_drawing.setdefault(measure.drawing, []).append(measure)
    return [page for drawing, measures in by_drawing.items() for page in DRAWINGS[drawing](measures, *arguments)]


def _with_operands(*measures: Measure) -> Iterator[Measure]:
    for measure in measures:
        yield measure
        yield from _with_operands(*measure.operands)
