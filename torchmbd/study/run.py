"""Run a study: watch it on the terminal, tell it to the tracker, end with a table, pictures and links.

Whatever happens, the runs end with a status that is true: FINISHED, KILLED (Ctrl-C, with what was computed),
FAILED (an exception, or no start succeeded). Results are sent before pictures are drawn: no picture costs a result.
Every evaluation is on disk before it is returned (evaluations.py), so the same command goes on where a study
ended, however it ended (unfinished.py). Checked in tests/study/test_run.py, test_resume.py.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.errors import InputError
from torchmbd.optimization import DiscreteResult, Iterate, MultistartResult
from torchmbd.optimization.cache import CachedProblem
from torchmbd.optimization.multistart import multistart
from torchmbd.optimization.multistart.workers import LANES
from torchmbd.study.dask_evaluator import study_workers
from torchmbd.study.discrete_polish import lay
from torchmbd.study.evaluations import Evaluations
from torchmbd.study.front import run_front
from torchmbd.study.journal import PARENT, Journal, percent
from torchmbd.study.listing import print_links_of, study_links
from torchmbd.study.metric_names import ANALYSES, CONVERGED, STARTS, constraint_names, gain, short
from torchmbd.study.paths import evaluations_file, problem_key, study_key
from torchmbd.study.progress import Progress
from torchmbd.study.report import print_results, study_pictures
from torchmbd.study.settings import Outcome, StudySettings
from torchmbd.study.sweep import run_sweep
from torchmbd.study.unfinished import Unfinished, claimed, unsent
from torchmbd.tracking import MlflowTracker, Record, Status, TrackingError
from torchmbd.tracking.catalog import Entry, find
from torchmbd.tracking.links import DEFAULT_BASE
from torchmbd.tracking.store import own_files, store_uri

EXIT: dict[Status, int] = {"FINISHED": 0, "FAILED": 1, "KILLED": 130}


def run_study(
    study: StudySettings,
    console: Console,
    tracker: MlflowTracker | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    fresh: bool = False,
    uri: str | None = None,
    source: Any = None,
    again: bool = False,
) -> int:
    """Run a study and return the exit code; what it finds is its `outcome`.

    tracker    hears of it; None: MLflow, and the same command goes on with the study until it has finished there
    workers    processes that evaluate: 1: this one; more: a Dask cluster on this machine; 0: one for each core
    scheduler  address of a Dask scheduler to use instead, or a cluster file (cluster.py)
    fresh      forget the evaluations of this problem, and begin the study anew
    uri        the MLflow store; None: that of the study
    source     evaluates what is not on disk; None: this process, or the workers
    again      go through a study that has finished, in its runs, with what is known; False: only say where it is
    """
    problem, key, began = study.simulated, problem_key(study.simulated), time.monotonic()
    pool = None
    if workers != 1 or scheduler is not None:
        pool = study_workers(study, key, getattr(problem, "rows", 0), workers, scheduler)
    with ExitStack() as stack:
        store = Evaluations(evaluations_file(), key)
        stack.callback(store.close)
        unfinished = None
        if tracker is None:
            uri = store_uri(uri or study.uri)
            file, overrides = (study.origin.file, study.origin.overrides) if study.origin else (None, ())
            claim = claimed(study_key(study, uri), study.name, file, overrides, uri, fresh)
            unfinished = stack.enter_context(claim)
            if unfinished.run_id and not again and (entry := _there(unfinished)):
                return _finished(study.name, unfinished, entry, console)
            tracker = MlflowTracker(study.experiment, uri, unfinished.id)
        if fresh:  # a study that is running has been refused by then
            store.forget()
        _say_what_is_known(study.name, store.count(), unfinished, console)
        source, lanes = source or problem, LANES
        if pool is not None:
            with console.status(f"waiting for workers of {escape(scheduler or 'this machine')}"):
                stack.enter_context(pool)
            source, lanes = pool, pool.lanes
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="torchmbd-")))
        journal = Journal(study, tracker, folder)
        remembered = CachedProblem(problem, store, source, journal.evaluated)
        status: Status = "FAILED"
        found: Any = None
        try:
            if study.sweep is not None:
                status = run_sweep(study, problem, remembered.evaluate, journal, console)
            elif study.front:
                found, status = run_front(study, remembered, lanes, journal, console)
            else:
                found, status = _search(study, remembered, store, lanes, journal, console)
        except KeyboardInterrupt:
            status = "KILLED"
        finally:
            journal.end_all(status)
            record = close(tracker, unfinished, console)
            study.outcome = Outcome(status, found, None if record is None else record.runs.get(PARENT))
        for what, trouble in (("The last evaluations are not on disk", store.trouble), ("A file", journal.trouble)):
            if trouble:
                console.print(f"{what}: {escape(trouble)}", style="red", soft_wrap=True)
        known = f", {remembered.hits} of {remembered.hits + remembered.computed} evaluations known"
        since = f"{time.monotonic() - began:.1f} s{known if remembered.hits else ''}"
        return conclude(study.name, study.kind, status, since, record, unfinished, console)


def _there(study: Unfinished) -> Entry | None:
    """The run in which a study has finished; None, and it begins anew, where its store has it no more."""
    try:
        return find(study.uri, study.run_id)
    except InputError:
        study.renew()
        return None


def _finished(name: str, study: Unfinished, entry: Entry, console: Console) -> int:
    """Say of a study that has finished where it is; the exit code."""
    best = entry.metrics.get("best_objective")
    outcome = "" if best is None else f", best objective {best:.6g}"
    console.print(f"{escape(name)}: finished on {study.ended}{outcome}; nothing is run again", soft_wrap=True)
    record = Record(study.uri, entry.experiment_id, {PARENT: entry.run_id})
    print_run_links(record, entry.kind, "FINISHED", console)
    short = entry.run_id[:8]
    console.print(
        f"its designs: torchmbd best {short}; to run it anew: {study.command} --fresh", soft_wrap=True, highlight=False
    )
    return EXIT["FINISHED"]


def _say_what_is_known(name: str, count: int, study: Unfinished | None, console: Console) -> None:
    """Say before the first evaluation what is on disk: of this study, which goes on, or of another of the same problem."""
    if count == 0:
        return
    text = f"{count} evaluations of this problem are on disk"
    if study is not None and study.continues:
        text = f"{f'finished on {study.ended}' if study.run_id else 'goes on'}; {text}"
    console.print(f"{escape(name)}: {text}", soft_wrap=True)


def _search(
    study: StudySettings, remembered: CachedProblem, store: Evaluations, lanes: int, journal: Journal, console: Console
) -> tuple[MultistartResult | DiscreteResult, Status]:
    """Optimize from every start, `lanes` of them at once."""
    points = study.points
    journal.begin("study")
    for index, point in enumerate(points):
        journal.begin_start(index, point)
    target = study.over(remembered)
    each = getattr(target, "simulations", 1)  # of one design
    options: dict[str, Any] = {"max_lanes": max(1, lanes // each)} | study.options
    title = f"{study.name}: {study.method} from {len(points)} start{'s' if len(points) > 1 else ''}"
    words = {"expected": "mean", "worst": "worst case"}.get(getattr(study.problem, "kind", ""))
    if words:
        console.print(f"the objective is its {words} over the tolerances", style="dim")
    with Progress(study.columns, len(points), title, console, study.sign, study.feasibility) as progress:

        def callback(iterate: Iterate) -> None:
            journal.iterate(iterate)
            progress.iterate(iterate)
            if store.trouble:
                progress.note(f"{store.trouble}; the study goes on, and keeps it in memory")
            if trouble := journal.tracker.trouble:
                progress.note(f"{trouble}; the study goes on")

        found = multistart(
            target,
            study.method,
            list(points),
            callback,
            journal.result,
            max_iterations=study.max_iterations,
            progress=False,  # the terminal shows the starts already
            **options,
        )
    best = found.best
    print_results(study, found, journal.failures, console)
    _summarize(found, study.sign, journal)
    if best is not None:
        journal.best(best)
    elif not found.interrupted:
        reason = _why_none(found, study)
        journal.summary({}, {"message": reason})
        console.print(f"No design to report: {reason}", soft_wrap=True, highlight=False, markup=False)
    result, interrupted = found, found.interrupted
    if best is not None and any(study.increments) and not interrupted:
        result = lay(study, target, points, options, found, journal, console)
        interrupted = result.status == "interrupted"
    visited = store.visited(len(study.simulated.start))
    study_pictures(study, found, visited, journal, console)
    if interrupted:
        return result, "KILLED"
    return result, "FINISHED" if best is not None else "FAILED"


def _why_none(found: MultistartResult, study: StudySettings) -> str:
    """Say why no start ended with a feasible design: what the nearest one violates, or why none was evaluated."""
    ended = [result for result in found.results if math.isfinite(result.violation)]
    if not ended:
        return found.results[0].message if found.results else "no start was evaluated"
    near = min(ended, key=lambda result: result.violation)
    rows = np.array(near.constraints, dtype=float).reshape(-1)
    equal = getattr(study.problem, "equalities", np.zeros(0, dtype=int))
    rows[equal] = np.abs(rows[equal])
    name = short(constraint_names(study.problem, len(rows))[int(np.argmax(rows))])
    return (
        f"no start ended with all constraints satisfied. The nearest is start {near.start}: {name!r} is beyond its limit by "
        f"{near.violation:.3g} (a share of the limit). Allowed: more iterations, other starts, another limit"
    )


def _summarize(study: MultistartResult, sign: float, journal: Journal) -> None:
    numbers = {STARTS: len(study.results), CONVERGED: study.converged, ANALYSES: study.analyses}
    tags = {}
    best = study.best
    if best is not None:
        initial = journal.first.get(0, float("nan"))
        value = sign * best.value
        numbers |= {"objective": value, "best_objective": value, "violation": best.violation}
        numbers |= {gain(sign): percent(initial, best.value)} if initial else {}
        numbers |= journal.shown(best.x)
        tags = {"best_start": str(best.start), "status": best.status, "message": best.message}
    journal.summary(numbers, tags)


def close(tracker: MlflowTracker, study: Unfinished | None, console: Console) -> Record | None:
    """Wait for the tracker; None, and a message, if not everything is in its store."""
    try:
        with console.status("writing the last of it to MLflow"):
            record = tracker.close()
    except TrackingError as error:
        console.print(f"Tracking failed: {escape(str(error))}", style="red", soft_wrap=True)
        return None
    if study is not None and record.runs:
        study.mark_sent()
    elif study is not None:  # nothing is there to go on with
        study.forget()
    return record


def conclude(
    name: str,
    kind: str,
    status: Status,
    since: str,
    record: Record | None,
    study: Unfinished | None,
    console: Console,
) -> int:
    """Say how it ended and where to look at it; return the exit code. A study that has finished is not run again."""
    console.print(f"{escape(name)}: {status.lower()} after {since}", soft_wrap=True)
    if record is None:
        return 1
    if PARENT in record.runs:
        print_run_links(record, kind, status, console)
    if status == "KILLED" and study is not None:
        console.print(f"to go on with it: {study.command}", soft_wrap=True, highlight=False, markup=False)
    if status == "FINISHED" and study is not None:
        if kind == "figures":  # their function may draw something else the next time
            study.forget()
        else:
            study.conclude(record.runs[PARENT])
    if waiting := unsent():
        console.print(f"{len(waiting)} earlier studies are not in their tracking store: torchmbd sync", soft_wrap=True)
    return EXIT[status]


def print_run_links(record: Record, kind: str, status: Status, console: Console) -> None:
    """Print where to look at a run."""
    run = record.runs[PARENT]
    served = record.uri.startswith(("http:", "https:"))
    base = record.uri.rstrip("/") if served else DEFAULT_BASE
    links = study_links(base, record.experiment_id, run, kind, status)
    if own := own_files(record.uri, run):
        console.print("To look at it: torchmbd ui, then", highlight=False)
        links["on disk"] = os.path.relpath(own) if own.is_relative_to(Path.cwd()) else str(own)
    print_links_of(links, console)
