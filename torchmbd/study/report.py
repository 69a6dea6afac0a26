"""The end of a study: a table of the starts, and its pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.design import Problem
from torchmbd.design.ply_failure import PlyFailure
from torchmbd.design.scenarios import Scenarios
from torchmbd.design.words import heading
from torchmbd.errors import MbdError
from torchmbd.optimization import MultistartResult
from torchmbd.study.journal import Journal
from torchmbd.study.progress import better, give_way, outcome, print_table, table_of
from torchmbd.study.settings import StudySettings
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


def print_results(study: StudySettings, found: MultistartResult, failures: Sequence[str], console: Console) -> None:
    """Print the starts, the best first, and what failed on the way."""
    if not found.results:
        console.print("No start came to a result.")
        return
    columns = ["start", "objective", better(study.sign), "viol.", *study.columns.headings, "iter", "sims", "status"]
    table = table_of(f"{study.name}: {len(found.results)} starts, {found.converged} converged", columns)
    best = found.best
    moved = [result for result in found.results if result.start == 0 and result.history]
    first = moved[0].history[0].objective if moved else float("nan")
    for result in sorted(found.results, key=lambda r: (not r.violation <= study.feasibility, r.value)):
        angles = [f"{value:z.2f}" for value in study.columns.shown(result.x).values()]
        cells = [str(result.start), *outcome(first, result.value, result.violation, study.sign), *angles]
        cells += [str(result.iterations), str(result.analyses), result.status.replace("_", " ")]
        table.add_row(*cells, style="bold" if best is not None and result.start == best.start else None)
    angles = give_way(4, len(study.columns.names), [-2, 3, -3, 2])
    if not print_table(table, console, angles) and best is not None:
        console.print(f"best design: {study.columns.named(best.x)}", soft_wrap=True, highlight=False)
    if failures:
        last = f"the last: {escape(failures[-1])}"
        console.print(
            f"{len(failures)} failed evaluations, which the optimizers stepped back from; {last}", soft_wrap=True
        )


_SHOWN = 6  # design variables that have room in a legend

Visited = tuple[np.ndarray, np.ndarray]  # designs [m, n], objectives [m]


def study_pictures(
    study: StudySettings, found: MultistartResult, visited: Visited, journal: Journal, console: Console
) -> None:
    """Draw what the question asks for, over iterations and over time, start against best, and all starts; file the pictures."""
    searches = {f"start {r.start}": r.history for r in found.results if r.history}
    if not searches or not any(np.isfinite(r.value) for r in found.results):  # nothing could be evaluated
        return
    best, problem = found.best, study.simulated
    objective = heading(problem.asked) if isinstance(problem, Problem) else "objective"
    chosen, title = None if best is None else f"start {best.start}", study.question or study.name
    draw(
        convergence,
        ["convergence.png"],
        journal,
        console,
        objectives={name: [study.sign * i.objective for i in history] for name, history in searches.items()},
        violations={name: [i.violation for i in history] for name, history in searches.items()},
        best=chosen,
        ylabel=objective,
    )
    draw(design_map, ["design_map.png"], journal, console, **_map(study, found, visited, objective))
    draw(
        parallel_coordinates,
        ["parallel_coordinates.png"],
        journal,
        console,
        **_ends(study, found, objective),
        title=title,
    )
    if (
        isinstance(problem, Problem) and study.problem is problem
    ):  # over tolerances the numbers are those of many designs
        given = {"problem": problem, "searches": searches, "best": chosen, "title": title}
        draw(criteria_over_iterations, _both("criteria_over_iterations"), journal, console, **given)
    with no_picture_costs_a_result(console):
        # An interrupted study is not asked for two simulations more.
        if best is not None and not found.interrupted and isinstance(problem, Problem):
            _motion_pictures(study, np.stack([problem.start, best.x[: len(problem.start)]]), problem, journal, console)


def _both(name: str) -> list[str]:
    """A picture for a browser and for print."""
    return [f"{name}.png", f"{name}.pdf"]


def draw(
    figure: Callable[..., Any], files: Sequence[str], journal: Journal, console: Console, **arguments: Any
) -> None:
    """File a figure of torchmbd.viz under one name or several; say why it is missing."""
    try:
        drawn = figure(**arguments)
        if drawn is None:  # nothing of this kind to draw
            return
        for name in files:
            journal.file(save(drawn, journal.folder / name), "figures")
    except Exception as error:  # matplotlib's, the disk's: no picture costs a result
        console.print(f"No picture: {escape(str(error) or type(error).__name__)}", style="red", soft_wrap=True)


@contextmanager
def no_picture_costs_a_result(console: Console) -> Iterator[None]:
    """Say why a picture is missing (a motion that fails, a full disk), and go on."""
    try:
        yield
    except (MbdError, OSError) as error:
        console.print(f"No picture: {escape(str(error))}", style="red", soft_wrap=True)


def _map(study: StudySettings, found: MultistartResult, visited: Visited, objective: str) -> dict[str, Any]:
    """Return the arguments of a map of where the starts went, and in which of the distinct minima they ended."""
    factors = study.columns.factors
    moved = [result for result in found.results if result.history]
    ends = {f"start {start}": k for k, minimum in enumerate(found.minima) for start in minimum.starts}
    seen = (
        (visited[0] / factors, study.sign * visited[1]) if visited[0].shape[1:] == factors.shape else None
    )  # extra variables
    return {
        "paths": {f"start {r.start}": np.array([i.x for i in r.history]) / factors for r in moved},
        "objectives": {f"start {r.start}": [study.sign * i.objective for i in r.history] for r in moved},
        "headings": study.columns.headings,
        "ends": ends,
        "visited": seen,
        "objective": objective,
    }


def _ends(study: StudySettings, found: MultistartResult, objective: str) -> dict[str, Any]:
    """Return the arguments of parallel coordinates of where the starts ended."""
    ended = [result for result in found.results if np.isfinite(result.value)]
    factors = study.columns.factors
    return {
        "designs": np.array([result.x for result in ended]).reshape(-1, len(factors)) / factors,
        "objectives": [study.sign * result.value for result in ended],
        "largest": study.sign < 0.0,
        "headings": study.columns.headings,
        "feasible": [result.violation <= study.feasibility for result in ended],
        "bounds": (np.asarray(study.problem.lower) / factors, np.asarray(study.problem.upper) / factors),
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
    given = {"motion": motion, "labels": labels, "title": title}
    draw(criteria_over_time, _both("criteria_over_time"), journal, console, problem=problem, **given)
    draw(weighted_parts, _both("weighted_parts"), journal, console, problem=problem, **given)
    measures = [problem.objective, *(constraint.measure for constraint in problem.constraints)]
    indices = [
        history for measure in measures for history, _ in histories_of(measure) if isinstance(history, PlyFailure)
    ]
    for body, criterion in dict.fromkeys((index.body, index.criterion) for index in indices):
        name = f"failure_{body}_{criterion}"
        draw(failure_map, _both(name), journal, console, body=body, criterion=criterion, **given)
    for lane, (name, label) in enumerate(zip(("motion_start", "motion_best"), labels, strict=True)):
        title = f"{study.name}: {label}"
        path = animate(motion, journal.folder / f"{name}.html", lane=lane, title=title, problem=problem)
        journal.file(path)
