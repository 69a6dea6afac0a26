"""Run a study: progress on the terminal, runs in the tracking store, at the end a table, pictures and links.

Runs end with the status FINISHED, KILLED (Ctrl-C, with the results so far) or FAILED (an exception, or no start succeeded).
Results are tracked before pictures are drawn, so that an error in a picture loses no result. Every evaluation is on disk
before it is returned (record/evaluations.py): the same command continues a study, however it ended (record/unfinished.py).
Checked in tests/study/test_run.py, test_resume.py.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.design import Problem
from torchmbd.design.verification import load_notes
from torchmbd.errors import LoadWarning, warnings_once
from torchmbd.optimization import DiscreteResult, Iterate, MultistartResult
from torchmbd.optimization.cache import CachedProblem
from torchmbd.optimization.multistart import multistart
from torchmbd.optimization.multistart.workers import LANES, Workers
from torchmbd.progress import stages_told
from torchmbd.results.answer import Verification
from torchmbd.study.dask_evaluator import study_workers
from torchmbd.study.discrete_polish import search_on_steps
from torchmbd.study.front import run_front
from torchmbd.study.record.evaluations import Evaluations
from torchmbd.study.record.journal import Journal
from torchmbd.study.record.metric_names import CONVERGED, STARTS, constraint_names, without_group
from torchmbd.study.record.paths import evaluations_file, problem_key
from torchmbd.study.record.run_record import UNVERIFIED
from torchmbd.study.record.unfinished import StudyState
from torchmbd.study.report.progress import Beginning, Progress
from torchmbd.study.report.terminal import active_text, print_results, save_pictures
from torchmbd.study.settings import Outcome, StudySettings
from torchmbd.study.sweep import run_sweep
from torchmbd.study.verify import verify_best
from torchmbd.summary import plural
from torchmbd.tracking import MlflowTracker, Status
from torchmbd.tracking.catalog import ACTIVE, SEARCH_TEXT
from torchmbd.tracking.uri import StoreURI


@warnings_once()
def run_study(
    study: StudySettings,
    console: Console,
    tracker: MlflowTracker | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    fresh: bool = False,
    uri: str | StoreURI | None = None,
    rerun_finished: bool = False,
) -> int:
    """Run a study and return the exit code; its results are in `study.outcome`.

    tracker         of the runs; None: one for the MLflow store, in which the same command continues the study
    workers         processes that evaluate: 1: this one; more: a Dask cluster on this machine; 0: one for each core
    scheduler       address of a Dask scheduler to use instead, or a cluster file (cluster.py)
    fresh           remove the evaluations of this problem, and begin the study anew
    uri             the MLflow store; None: that of the study
    rerun_finished  run a finished study again, with its evaluations on disk and in its runs; False: print where it is
    """
    problem, key = study.simulated, problem_key(study.simulated)
    pool = None
    if workers != 1 or scheduler is not None:
        pool = study_workers(study, key, getattr(problem, "rows", 0), workers, scheduler)
    with ExitStack() as stack:
        store = Evaluations(evaluations_file(), key)
        stack.callback(store.close)
        journal = Journal(study, console, tracker, uri)
        stack.enter_context(journal.claimed(fresh))
        if not rerun_finished:
            code = journal.tell_finished("torchmbd best {run}", workers=workers, scheduler=scheduler)
            if code is not None:
                return code
        if fresh:  # `claim_study` has refused a study that is running in another process
            store.forget()
        _print_stored_count(study.name, store.count(), journal.state, console)
        evaluator, lanes = problem, LANES
        if pool is not None:
            with console.status(f"waiting for workers of {escape(scheduler or 'this machine')}"):
                _enter(pool, stack, journal.state)
            evaluator, lanes = pool, pool.lanes
        beginning = Beginning(console)
        stack.enter_context(stages_told(beginning.stage))
        stores = [store]

        def others(other: Any) -> tuple[Evaluations, Any]:
            """Store and evaluator of the problem by other steps."""
            stores.append(Evaluations(evaluations_file(), problem_key(other)))
            stack.callback(stores[-1].close)
            if fresh:
                stores[-1].forget()
            return stores[-1], other if pool is None else pool.for_problem(other)

        cached = CachedProblem(problem, store, evaluator, journal.evaluated, beginning.batch, others)
        result: Any = None
        verified: Verification | None = None

        def run() -> Status:
            nonlocal result, verified
            if study.sweep is not None:
                result, status = run_sweep(study, problem, cached.evaluate, journal, console)
            elif study.front:
                result, status = run_front(study, cached, lanes, journal, console)
            else:
                with _load_warnings_in_answer(study):
                    result, status, verified = _search(study, cached, stores, lanes, journal, console)
            return status

        try:
            journal.carry_out(run, lambda: _trouble(stores))
        finally:
            study.outcome = Outcome(journal.status, result, journal.run_id, verified)
        known = f", {cached.hits} of {cached.hits + cached.computed} evaluations known" if cached.hits else ""
        code = journal.tell_outcome(known, workers=workers, scheduler=scheduler)
        return code or (0 if verified is None or verified.verified else UNVERIFIED)


@contextmanager
def _load_warnings_in_answer(study: StudySettings) -> Iterator[None]:
    """Leave out warnings of loads, which the answer of a study of simulations tells."""
    with warnings.catch_warnings():
        if isinstance(study.simulated, Problem):
            warnings.simplefilter("ignore", LoadWarning)
        yield


def _trouble(stores: Sequence[Evaluations]) -> str | None:
    """Return why evaluations are kept in memory, None where all are on disk."""
    return next((store.trouble for store in stores if store.trouble), None)


def _enter(pool: Workers, stack: ExitStack, study: StudyState | None) -> None:
    """Start workers; a study that has not begun leaves nothing behind if there are none."""
    try:
        stack.enter_context(pool)
    except BaseException:
        if study is not None and not study.continues:
            study.forget()
        raise


def _print_stored_count(name: str, count: int, study: StudyState | None, console: Console) -> None:
    """Print how many evaluations of the problem are on disk, from this study or others, and whether this study is continued."""
    if count == 0:
        return
    text = f"{count} evaluations of this problem are on disk"
    if study is not None and study.continues:
        text = f"{f'finished on {study.ended}' if study.run_id else 'goes on'}; {text}"
    console.print(f"{escape(name)}: {text}", soft_wrap=True)


def _search(
    study: StudySettings,
    cached: CachedProblem,
    stores: Sequence[Evaluations],
    lanes: int,
    journal: Journal,
    console: Console,
) -> tuple[MultistartResult | DiscreteResult, Status, Verification | None]:
    """Optimize from every start, with `lanes` simulations in a batch; track and report the results."""
    points = study.points
    journal.begin_study()
    for index, point in enumerate(points):
        journal.begin_start(index, point)
    target = study.with_evaluator(cached)
    each = getattr(target, "simulations", 1)  # of one design
    options: dict[str, Any] = {"max_lanes": max(1, lanes // each)} | study.options
    title = f"{study.name}: {study.method} from {plural(len(points), 'start')}"
    words = {"expected": "mean", "worst": "worst case"}.get(getattr(study.problem, "kind", ""))
    if words:
        console.print(f"the objective is its {words} over the tolerances", style="dim")
    with Progress(study.columns, len(points), title, console, study.sign, study.feasibility) as progress:

        def callback(iterate: Iterate) -> None:
            journal.iterate(iterate)
            progress.iterate(iterate)
            if trouble := _trouble(stores):
                progress.note(f"{trouble}; the study goes on, and keeps it in memory")
            if trouble := journal.tracker.trouble:
                progress.note(f"{trouble}; the study goes on, and sends it later")

        outcome = multistart(
            target,
            study.method,
            list(points),
            callback,
            journal.result,
            max_iterations=study.max_iterations,
            progress=False,  # the terminal shows the starts already
            **options,
        )
    best = outcome.best
    print_results(study, outcome, journal, console)
    _summarize(outcome, journal)
    if best is not None:
        journal.best(best)
    elif not outcome.interrupted:
        reason = _no_design_reason(outcome, study)
        journal.summary({}, {"message": reason})
        console.print(f"No design to report: {reason}", soft_wrap=True, highlight=False, markup=False)
    result, interrupted = outcome, outcome.interrupted
    if best is not None and any(study.increments) and not interrupted:
        result = search_on_steps(study, best.problem, points, options, outcome, journal, console)
        interrupted = result.status == "interrupted"
    verified = None
    if best is not None and not interrupted:
        last = result.best
        verified = verify_best(study, best if last is None else last, outcome, result is outcome, journal, console)
    if verified is None and isinstance(study.simulated, Problem):
        for note in load_notes(study.simulated, study.simulated.start if best is None else best.x):
            console.print(f"({note})", soft_wrap=True, highlight=False, markup=False)
    visited = stores[-1].visited(len(study.simulated.start))
    save_pictures(study, outcome, visited, journal, console)
    if interrupted:
        return result, "KILLED", None
    return result, "FINISHED" if best is not None else "FAILED", verified


def _no_design_reason(outcome: MultistartResult, study: StudySettings) -> str:
    """Return why no start ended with a feasible design: what the nearest one violates, or why none was evaluated."""
    ended = [result for result in outcome.results if math.isfinite(result.violation)]
    if not ended:
        return outcome.results[0].message if outcome.results else "no start was evaluated"
    near = min(ended, key=lambda result: result.violation)
    rows = np.array(near.constraints, dtype=float).reshape(-1)
    equal = getattr(study.problem, "equalities", np.zeros(0, dtype=int))
    rows[equal] = np.abs(rows[equal])
    name = without_group(constraint_names(study.problem, len(rows))[int(np.argmax(rows))])
    late = any(result.status == "max_time" for result in outcome.results)
    more = "a larger max_time, with which the same command goes on" if late else "more iterations"
    return (
        f"no start ended with all constraints satisfied. The nearest is start {near.start}: {name!r} is beyond its limit by "
        f"{near.violation:.3g} (a share of the limit). Try: {more}, other starts, another limit"
    )


def _summarize(result: MultistartResult, journal: Journal) -> None:
    numbers = {STARTS: len(result.results), CONVERGED: result.converged}
    tags = {}
    best = result.best
    if best is not None:
        journal.outcome(best.x, best.value, best.violation)
        tags = {"best_start": str(best.start), "status": best.status, "message": best.message}
        tags |= {ACTIVE: active_text(best), "accuracy": getattr(best.problem, "accuracy", "")}
    tags |= {SEARCH_TEXT: result.search_text}
    journal.summary(numbers, tags)
