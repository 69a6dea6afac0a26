"""A search whose problem gets finer as it nears an optimum, the same for one start and for many.

    coarse problem, half of the iterations at most -> problem refined for the best design there -> ... until it needs no finer

A problem that can be refined has `coarse`, a problem of less accuracy or None, and `refined(x)`, one of the accuracy that a
design x needs, or None where it has it; such as a Problem that chooses its steps (design/problem_steps.py). Its `accuracy`
names what it is evaluated by. Others are searched once.

All starts are searched by one problem at a time, and each part begins where the one before it ended: with no iteration left it
only evaluates the design. So all results are those of one problem, the last. The first entry of a history is the start by this
problem; each entry has the `accuracy` by which it was evaluated. Counts are those of all parts.
Checked in tests/optimization/test_finer_motions.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from torchmbd.optimization.failures import counted
from torchmbd.optimization.optimizer import Evaluation, Iterate, OptimizationResult, largest_violation

Begin = tuple[np.ndarray, int, list[OptimizationResult]]  # design [n], iterations at most, parts of this start before
Search = Callable[[Any, Mapping[int, Begin]], dict[int, OptimizationResult]]
_FEWEST = 4  # iterations that are worth a coarse part
STOPPED = ("interrupted", "max_time")  # statuses after which nothing is simulated
ENDED = ("failed", "infeasible", *STOPPED)  # statuses after which no part follows
_NONE_LEFT = "the limits left no iteration by the finer motions that the best design needs"


def refines(problem: Any) -> bool:
    """Return whether a search of the problem may have several parts."""
    return hasattr(type(problem), "refined")  # not what a wrapper passes on, whose evaluations it would miss


def search_with_finer_motions(
    search: Search, problem: Any, points: Mapping[int, np.ndarray], max_iterations: int
) -> dict[int, OptimizationResult]:
    """Search from designs [n] by parts; return the result of each start that was begun.

    search   searches (problem, starts); starts that it does not begin are left out of what it returns
    points   designs by the numbers of the starts
    """
    coarse = problem.coarse if refines(problem) and max_iterations >= _FEWEST else None
    parts: dict[int, list[OptimizationResult]] = {}
    begins: dict[int, Begin] = {
        k: (x, max_iterations if coarse is None else max_iterations // 2, []) for k, x in points.items()
    }
    present = problem if coarse is None else coarse
    while True:
        ends = search(present, begins)
        for start, end in ends.items():
            parts.setdefault(start, []).append(end)
        is_coarse = present is coarse
        if any(end.status in STOPPED for end in ends.values()):
            break
        open_ends = {start: end for start, end in ends.items() if end.status not in ENDED}
        if is_coarse:
            best = _best(open_ends)
            present = (None if best is None else problem.refined(best.x)) or problem
            open_ends = dict(ends)
        else:
            best = _best(open_ends)
            finer = present.refined(best.x) if refines(present) and best is not None else None
            if finer is None:
                break
            present = finer
        begins = {}
        for start, end in open_ends.items():
            done = sum(part.iterations for part in parts[start])
            x = points[start] if end.status in ENDED else end.x
            begins[start] = x, max(max_iterations - done, 0), parts[start]
    joined = {start: _joined(every) for start, every in parts.items()}
    return {start: with_many_failures(end) for start, end in _with_starts(joined, parts, points).items()}


def _best(ends: Mapping[int, OptimizationResult]) -> OptimizationResult | None:
    """The feasible end of lowest value, else the least infeasible one."""
    return min(ends.values(), key=lambda end: (end.violation > end.feasibility, end.value), default=None)


def _joined(parts: list[OptimizationResult]) -> OptimizationResult:
    """The last result, with the history and the counts of all."""
    if len(parts) == 1:
        return parts[0]
    history, done, analyses = list(parts[0].history), parts[0].iterations, parts[0].analyses
    for part in parts[1:]:
        if history and part.history and np.array_equal(history[-1].x, part.history[0].x):  # the same design, once more
            first = part.history[0]
            history[-1] = replace(first, iteration=history[-1].iteration, analyses=analyses + first.analyses)
        history += [
            replace(iterate, iteration=done + iterate.iteration, analyses=analyses + iterate.analyses)
            for iterate in part.history
            if iterate.iteration or not history
        ]
        done, analyses = done + part.iterations, analyses + part.analyses
    counts = {name: sum(getattr(part, name) for part in parts) for name in ("gradient_evaluations", "failures")}
    reasons = counted(pair for part in parts for pair in part.reasons.items())
    last = parts[-1]
    if last.status == "max_iterations" and not last.iterations:
        last = replace(last, message=f"{parts[-2].message}; {_NONE_LEFT}")
    return replace(last, history=history, iterations=done, analyses=analyses, reasons=reasons, **counts)


def _with_starts(
    ends: dict[int, OptimizationResult],
    parts: Mapping[int, list[OptimizationResult]],
    points: Mapping[int, np.ndarray],
) -> dict[int, OptimizationResult]:
    """The results with the starts by the problem of the results as the first entries of their histories."""
    moved = [k for k, every in parts.items() if len(every) > 1 and every[-1].status not in STOPPED and ends[k].history]
    if not moved:
        return ends
    problem = ends[moved[0]].problem
    evaluations = problem.evaluate(np.stack([points[k] for k in moved]), False)
    results = dict(ends)
    for k, evaluation in zip(moved, evaluations, strict=True):
        end = ends[k]
        first = _first_iterate(end.history[0], evaluation, problem)
        extra = {"analyses": end.analyses + 1}
        if not evaluation.ok:
            extra |= {"failures": end.failures + 1, "reasons": counted([*end.reasons.items(), (evaluation.status, 1)])}
        results[k] = replace(end, history=[first, *end.history[1:]], **extra)
    return results


def _first_iterate(iterate: Iterate, evaluation: Evaluation, problem: Any) -> Iterate:
    """The first entry of a history by another evaluation of its design."""
    c = np.atleast_1d(evaluation.constraints)
    equality = np.isin(np.arange(len(c)), getattr(problem, "equalities", []))
    return replace(
        iterate,
        objective=evaluation.objective,
        constraints=c,
        violation=largest_violation(c, equality) if evaluation.ok else float("nan"),
        status=evaluation.status,
        accuracy=getattr(problem, "accuracy", ""),
    )


def counted_from(parts: list[OptimizationResult], report: Callable[[Iterate], None]) -> Callable[[Iterate], None]:
    """Reports iterates after those of earlier parts; the first is known."""
    if not parts:
        return report
    done, analyses = sum(part.iterations for part in parts), sum(part.analyses for part in parts)

    def report_further(iterate: Iterate) -> None:
        if iterate.iteration:
            report(replace(iterate, iteration=done + iterate.iteration, analyses=analyses + iterate.analyses))

    return report_further


def with_many_failures(result: OptimizationResult) -> OptimizationResult:
    """The result with the status "many_failures" where more than a tenth of its evaluations failed."""
    if not result.failing_text or result.status in ENDED:
        return result
    message = f"{result.failing_text}; apart from this, {result.status.replace('_', ' ')}: {result.message}"
    return replace(result, status="many_failures", message=message)
