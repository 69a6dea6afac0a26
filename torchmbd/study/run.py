"""Run a study: progress on the terminal, runs in the tracking store, at the end a table, pictures and links.

Runs end with the status FINISHED, KILLED (Ctrl-C, with the results so far) or FAILED (an exception, or no start succeeded).
Results are tracked before pictures are drawn, so that an error in a picture loses no result. Every evaluation is on disk
before it is returned (evaluations.py): the same command continues a study, however it ended (unfinished.py).
Over 300 lines: what is printed at each way in which a study ends.
Checked in tests/study/test_run.py, test_resume.py.
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
from torchmbd.optimization.multistart.workers import LANES, Workers
from torchmbd.progress import stages_told
from torchmbd.results.answer import NOT_VERIFIED, Verification
from torchmbd.study.dask_evaluator import study_workers
from torchmbd.study.discrete_polish import search_on_steps
from torchmbd.study.evaluations import Evaluations
from torchmbd.study.front import run_front
from torchmbd.study.journal import PARENT, Journal, percent
from torchmbd.study.listing import print_links_of, study_links
from torchmbd.study.metric_names import ANALYSES, CONVERGED, STARTS, constraint_names, gain_metric, without_group
from torchmbd.study.paths import evaluations_file, problem_key, study_key
from torchmbd.study.progress import Beginning, Progress
from torchmbd.study.report import print_results, save_pictures
from torchmbd.study.settings import Outcome, StudySettings
from torchmbd.study.sweep import run_sweep
from torchmbd.study.unfinished import StudyState, claim_study, unsent
from torchmbd.study.verify import verify_best
from torchmbd.tracking import MlflowTracker, Record, Status, TrackingError
from torchmbd.tracking.catalog import VERIFICATION, Entry, find
from torchmbd.tracking.links import DEFAULT_BASE
from torchmbd.tracking.store import own_files, store_uri
from torchmbd.tracking.uri import StoreURI

EXIT: dict[Status, int] = {"FINISHED": 0, "FAILED": 1, "KILLED": 130}
UNVERIFIED = 3  # exit code of a study that is finished, and whose best design does not hold in a finer model (cli.py)


def run_study(
    study: StudySettings,
    console: Console,
    tracker: MlflowTracker | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    fresh: bool = False,
    uri: str | StoreURI | None = None,
    evaluator: Any = None,
    rerun_finished: bool = False,
) -> int:
    """Run a study and return the exit code; its results are in `study.outcome`.

    tracker         of the runs; None: one for the MLflow store, in which the same command continues the study
    workers         processes that evaluate: 1: this one; more: a Dask cluster on this machine; 0: one for each core
    scheduler       address of a Dask scheduler to use instead, or a cluster file (cluster.py)
    fresh           remove the evaluations of this problem, and begin the study anew
    uri             the MLflow store; None: that of the study
    evaluator       evaluates designs that are not on disk; None: this process, or the workers
    rerun_finished  run a finished study again, with its evaluations on disk and in its runs; False: print where it is
    """
    problem, key, start_time = study.simulated, problem_key(study.simulated), time.monotonic()
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
            claim = claim_study(study_key(study, uri), study.name, file, overrides, uri, fresh)
            unfinished = stack.enter_context(claim)
            if unfinished.run_id and not rerun_finished and (entry := _finished_run(unfinished, uri)):
                again = unfinished.command(workers=workers, scheduler=scheduler, fresh=True)
                return _print_finished(study.name, unfinished, uri, entry, again, console)
            tracker = MlflowTracker(study.experiment, uri, unfinished.id)
        if fresh:  # `claim_study` has refused a study that is running in another process
            store.forget()
        _print_stored_count(study.name, store.count(), unfinished, console)
        evaluator, lanes = evaluator or problem, LANES
        if pool is not None:
            with console.status(f"waiting for workers of {escape(scheduler or 'this machine')}"):
                _enter(pool, stack, unfinished)
            evaluator, lanes = pool, pool.lanes
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="torchmbd-")))
        journal = Journal(study, tracker, folder)
        beginning = Beginning(console)
        stack.enter_context(stages_told(beginning.stage))
        cached = CachedProblem(problem, store, evaluator, journal.evaluated, beginning.batch)
        status: Status = "FAILED"
        result: Any = None
        verified: Verification | None = None
        try:
            if study.sweep is not None:
                result, status = run_sweep(study, problem, cached.evaluate, journal, console)
            elif study.front:
                result, status = run_front(study, cached, lanes, journal, console)
            else:
                result, status, verified = _search(study, cached, store, lanes, journal, console)
        except KeyboardInterrupt:
            status = "KILLED"
        finally:
            journal.end_all(status)
            record = close_tracker(tracker, unfinished, console, store.trouble)
            run_id = None if record is None else record.runs.get(PARENT)
            study.outcome = Outcome(status, result, run_id, verified)
        if journal.trouble:
            console.print(f"A file is missing: {escape(journal.trouble)}", style="red", soft_wrap=True)
        known = f", {cached.hits} of {cached.hits + cached.computed} evaluations known"
        duration = f"{time.monotonic() - start_time:.1f} s{known if cached.hits else ''}"
        again = unfinished.command(workers=workers, scheduler=scheduler) if unfinished else ""
        code = print_outcome(study.name, study.kind, status, duration, record, unfinished, console, again)
        return code or (0 if verified is None or verified.verified else UNVERIFIED)


def _enter(pool: Workers, stack: ExitStack, study: StudyState | None) -> None:
    """Start workers; a study that has not begun leaves nothing behind if there are none."""
    try:
        stack.enter_context(pool)
    except BaseException:
        if study is not None and not study.continues:
            study.forget()
        raise


def _finished_run(study: StudyState, uri: StoreURI) -> Entry | None:
    """Return the run in which a study has finished; None, with its state renewed, if its store has no such run."""
    try:
        return find(uri, study.run_id)
    except InputError:
        study.renew()
        return None


def _print_finished(name: str, study: StudyState, uri: StoreURI, entry: Entry, again: str, console: Console) -> int:
    """Print where the run of a finished study is, and return the exit code."""
    best = entry.metrics.get("best_objective")
    outcome = "" if best is None else f", best objective {best:.6g}"
    console.print(f"{escape(name)}: finished on {study.ended}{outcome}; nothing is run again", soft_wrap=True)
    record = Record(uri, entry.experiment_id, {PARENT: entry.run_id})
    print_run_links(record, entry.kind, "FINISHED", console)
    verified = entry.tags.get(VERIFICATION, "")
    if verified:
        console.print(verified, soft_wrap=True, highlight=False, markup=False)
    short = entry.run_id[:8]
    console.print(f"its designs: torchmbd best {short}; to run it anew: {again}", soft_wrap=True, highlight=False)
    return UNVERIFIED if verified.startswith(NOT_VERIFIED) else EXIT["FINISHED"]


def _print_stored_count(name: str, count: int, study: StudyState | None, console: Console) -> None:
    """Print how many evaluations of the problem are on disk, from this study or others, and whether this study is continued."""
    if count == 0:
        return
    text = f"{count} evaluations of this problem are on disk"
    if study is not None and study.continues:
        text = f"{f'finished on {study.ended}' if study.run_id else 'goes on'}; {text}"
    console.print(f"{escape(name)}: {text}", soft_wrap=True)


def _search(
    study: StudySettings, cached: CachedProblem, store: Evaluations, lanes: int, journal: Journal, console: Console
) -> tuple[MultistartResult | DiscreteResult, Status, Verification | None]:
    """Optimize from every start, with `lanes` simulations in a batch; track and report the results."""
    points = study.points
    journal.begin("study")
    for index, point in enumerate(points):
        journal.begin_start(index, point)
    target = study.with_evaluator(cached)
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
                progress.note(f"{trouble}; the study goes on, and sends it later")

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
        reason = _no_design_reason(found, study)
        journal.summary({}, {"message": reason})
        console.print(f"No design to report: {reason}", soft_wrap=True, highlight=False, markup=False)
    result, interrupted = found, found.interrupted
    if best is not None and any(study.increments) and not interrupted:
        result = search_on_steps(study, target, points, options, found, journal, console)
        interrupted = result.status == "interrupted"
    verified = None
    if best is not None and not interrupted:
        last = result.best
        verified = verify_best(
            study, best if last is None else last, found if result is found else None, journal, console
        )
    visited = store.visited(len(study.simulated.start))
    save_pictures(study, found, visited, journal, console)
    if interrupted:
        return result, "KILLED", None
    return result, "FINISHED" if best is not None else "FAILED", verified


def _no_design_reason(found: MultistartResult, study: StudySettings) -> str:
    """Return why no start ended with a feasible design: what the nearest one violates, or why none was evaluated."""
    ended = [result for result in found.results if math.isfinite(result.violation)]
    if not ended:
        return found.results[0].message if found.results else "no start was evaluated"
    near = min(ended, key=lambda result: result.violation)
    rows = np.array(near.constraints, dtype=float).reshape(-1)
    equal = getattr(study.problem, "equalities", np.zeros(0, dtype=int))
    rows[equal] = np.abs(rows[equal])
    name = without_group(constraint_names(study.problem, len(rows))[int(np.argmax(rows))])
    return (
        f"no start ended with all constraints satisfied. The nearest is start {near.start}: {name!r} is beyond its limit by "
        f"{near.violation:.3g} (a share of the limit). Allowed: more iterations, other starts, another limit"
    )


def _summarize(result: MultistartResult, sign: float, journal: Journal) -> None:
    numbers = {STARTS: len(result.results), CONVERGED: result.converged, ANALYSES: result.analyses}
    tags = {}
    best = result.best
    if best is not None:
        initial = journal.first.get(0, float("nan"))
        value = sign * best.value
        numbers |= {"objective": value, "best_objective": value, "violation": best.violation}
        numbers |= {gain_metric(sign): percent(initial, best.value)} if initial else {}
        numbers |= journal.design_metrics(best.x)
        tags = {"best_start": str(best.start), "status": best.status, "message": best.message}
    journal.summary(numbers, tags)


def close_tracker(
    tracker: MlflowTracker, study: StudyState | None, console: Console, trouble: str | None = None
) -> Record | None:
    """Wait until everything is in the store; None, with a message, if the tracker gives up.

    trouble  why the last evaluations are not on disk, None if they are
    """
    record = None
    try:
        with console.status("writing the last of it to MLflow"):
            record = tracker.close()
    except TrackingError as error:
        console.print(f"Tracking failed: {escape(str(error))}", style="red", soft_wrap=True)
    if trouble:
        again = "" if record else ". When both take them, the same command makes them again and sends the study"
        console.print(f"The last evaluations are not on disk: {escape(trouble)}{again}", style="red", soft_wrap=True)
    elif record is None and tracker.trouble:
        text = "When the store takes them, `torchmbd sync` sends the study: what it has computed is on disk"
        console.print(text, style="red", soft_wrap=True)
    if record is None:
        return None
    if study is not None and record.runs:
        study.mark_sent()
    elif study is not None:  # no run has begun
        study.forget()
    return record


def print_outcome(
    name: str,
    kind: str,
    status: Status,
    duration: str,
    record: Record | None,
    study: StudyState | None,
    console: Console,
    again: str,
) -> int:
    """Print how a study ended and where its run is, update its state on disk, and return the exit code.

    again  the command that goes on with it
    """
    console.print(f"{escape(name)}: {status.lower()} after {duration}", soft_wrap=True)
    if record is None:
        return 1
    if PARENT in record.runs:
        print_run_links(record, kind, status, console)
    if status == "KILLED" and study is not None:
        console.print(f"to go on with it: {again}", soft_wrap=True, highlight=False, markup=False)
    if status == "FINISHED" and study is not None:
        if kind == "figures":  # their function may draw other figures the next time
            study.forget()
        else:
            study.mark_finished(record.runs[PARENT])
    if waiting := unsent():
        console.print(f"{len(waiting)} earlier studies are not in their tracking store: torchmbd sync", soft_wrap=True)
    return EXIT[status]


def print_run_links(record: Record, kind: str, status: Status, console: Console) -> None:
    """Print the links of a run."""
    run = record.runs[PARENT]
    base = record.uri.page if record.uri.served else DEFAULT_BASE
    links = study_links(base, record.experiment_id, run, kind, status)
    if own := own_files(record.uri, run):
        console.print("To look at it: torchmbd ui, then", highlight=False)
        links["on disk"] = os.path.relpath(own) if own.is_relative_to(Path.cwd()) else str(own)
    print_links_of(links, console)
