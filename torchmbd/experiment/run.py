"""Run a plan: watch it on the terminal, tell it to the tracker, end with a table, pictures and links.

Whatever happens, the runs end with a status that is true: FINISHED, KILLED (Ctrl-C, with what was computed),
FAILED (an exception, or no start succeeded). Results are told before pictures are drawn: no picture costs a result.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.design import Problem
from torchmbd.experiment.assemble import problem_of, starts_of
from torchmbd.experiment.journal import PARENT, Journal
from torchmbd.experiment.listing import print_links_of, study_links
from torchmbd.experiment.load import Plan
from torchmbd.experiment.progress import Progress
from torchmbd.experiment.report import print_results, study_pictures
from torchmbd.experiment.schema import Optimizer
from torchmbd.experiment.sweep import run_sweep
from torchmbd.optimizers import Evaluation, Iterate, Study, multistart
from torchmbd.tracking import ProcessTracker, Record, Status, Tracker, TrackingError
from torchmbd.tracking.links import DEFAULT_BASE
from torchmbd.tracking.store import sqlite_file

EXIT: dict[Status, int] = {"FINISHED": 0, "FAILED": 1, "KILLED": 130}


class Observed:
    """A problem as optimizers see it, whose evaluations a listener sees as well."""

    def __init__(self, problem: Problem, listener: Callable[[np.ndarray, list[Evaluation]], None]) -> None:
        self._problem, self._listener = problem, listener
        self.names, self.start, self.lower, self.upper = problem.names, problem.start, problem.lower, problem.upper

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        evaluations = self._problem.evaluate(X, gradients)
        self._listener(X, evaluations)
        return evaluations


def run_plan(plan: Plan, console: Console, tracker: Tracker | None = None) -> int:
    """Run a study or a sweep and return the exit code."""
    problem = problem_of(plan)
    tracking = plan.study.tracking
    tracker = tracker or ProcessTracker(tracking.experiment, tracking.uri)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="torchmbd-") as folder:
        journal = Journal(plan, tracker, Path(folder))
        status: Status = "FAILED"
        try:
            kind = run_sweep if plan.study.sweep else run_study
            status = kind(plan, problem, journal, console)
        except KeyboardInterrupt:
            status = "KILLED"
        finally:
            journal.end_all(status)
            record = _close(tracker, console)
    console.print(f"{plan.name}: {status.lower()} after {time.monotonic() - began:.1f} s")
    if record is None:
        return 1
    _print_links(record, "sweep" if plan.study.sweep else "study", status, console)
    return EXIT[status]


def run_study(plan: Plan, problem: Problem, journal: Journal, console: Console) -> Status:
    """Optimize from every start."""
    optimizer = plan.study.optimizer or Optimizer()
    recipe = starts_of(plan, problem.start)
    observed = Observed(problem, journal.evaluated)
    points = recipe.points(observed)
    journal.begin("study")
    for index, point in enumerate(points):
        journal.begin_start(index, point)
    title = f"{plan.name}: {optimizer.name} from {len(points)} start{'s' if len(points) > 1 else ''}"
    with Progress(plan.columns, len(points), title, console) as progress:

        def callback(iterate: Iterate) -> None:
            journal.iterate(iterate)
            progress.iterate(iterate)
            if getattr(journal.tracker, "lost", False):
                progress.note("The tracking store cannot be written: the study goes on unrecorded.")

        study = multistart(
            observed,
            optimizer.name,
            list(points),
            callback,
            max_iterations=optimizer.max_iterations,
            **optimizer.options,
        )
    best = study.best
    for result in study.results:
        journal.result(result, best is not None and result.start == best.start)
    print_results(plan, study, journal.failures, console)
    _summarize(study, journal)
    study_pictures(plan, study, problem, journal, console)
    if study.interrupted:
        return "KILLED"
    return "FINISHED" if best is not None else "FAILED"


def _summarize(study: Study, journal: Journal) -> None:
    numbers = {"starts": len(study.results), "converged_starts": study.converged, "analyses": study.analyses}
    tags = {}
    best = study.best
    if best is not None:
        initial = journal.first.get(0, float("nan"))
        numbers |= {"objective": best.value, "best_objective": best.value, "violation": best.violation}
        numbers |= {"reduction_percent": 100.0 * (1.0 - best.value / initial)} if initial else {}
        numbers |= journal.plan.columns.shown(best.x)
        tags = {"best_start": str(best.start), "status": best.status, "message": best.message}
    journal.summary(numbers, tags)


def _close(tracker: Tracker, console: Console) -> Record | None:
    try:
        with console.status("writing the last of it to MLflow"):
            return tracker.close()
    except TrackingError as error:
        console.print(f"Tracking failed: {escape(str(error))}", style="red")
        return None


def _print_links(record: Record, kind: str, status: Status, console: Console) -> None:
    run = record.runs.get(PARENT)
    if run is None:
        return
    served = record.uri.startswith(("http:", "https:"))
    base = record.uri.rstrip("/") if served else DEFAULT_BASE
    links = study_links(base, record.experiment_id, run, kind, status)
    if file := sqlite_file(record.uri):
        console.print("To look at it: torchmbd ui, then", highlight=False)
        links["on disk"] = str(file.parent / "mlartifacts" / run / "artifacts")
    print_links_of(links, console)
