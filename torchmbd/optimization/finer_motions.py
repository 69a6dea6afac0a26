"""A search whose problem gets finer as it nears an optimum.

    coarse problem, at most half of the iterations -> problem refined for the design there -> ... until it needs no finer one

A problem that can be refined has `coarse`, a problem of less accuracy or None, and `refined(x)`, one of the accuracy that a
design x needs, or None where it has it; such as a Problem that chooses its steps (design/problem_steps.py). Others are searched
once. Each part begins where the one before it ended. History and counts are those of all parts; values are those of the problem
that was searched then.
Checked in tests/optimization/test_finer_motions.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from torchmbd.optimization.failures import counted
from torchmbd.optimization.optimizer import Iterate, OptimizationResult

Search = Callable[[Any, np.ndarray, int, Callable[[Iterate], None]], OptimizationResult]
_FEWEST = 4  # iterations that are worth a coarse part
ENDED = ("failed", "interrupted", "infeasible")  # statuses after which no part follows


def search_with_finer_motions(
    search_from: Search, problem: Any, x: np.ndarray, max_iterations: int, report: Callable[[Iterate], None]
) -> OptimizationResult:
    """Search from x [n] by parts.

    search_from   searches (problem, start, iterations at most, report)
    """
    refines = hasattr(type(problem), "refined")  # not what a wrapper passes on, whose evaluations it would miss
    coarse = problem.coarse if refines and max_iterations >= _FEWEST else None
    parts: list[OptimizationResult] = []
    if coarse is not None:
        parts.append(search_from(coarse, x, max_iterations // 2, report))
        if parts[-1].status not in ENDED:
            x = parts[-1].x
            problem = problem.refined(x) or problem
    while True:
        done = sum(part.iterations for part in parts)
        part = search_from(problem, x, max_iterations - done, _counted_from(done, report) if parts else report)
        parts.append(part)
        finer = problem.refined(part.x) if refines and part.status not in ENDED else None
        if finer is None:
            return with_many_failures(_joined(parts))
        problem, x = finer, part.x
        if done + part.iterations >= max_iterations:
            text = f"{part.message}; the limits left no iteration by the finer motions that this design needs"
            return with_many_failures(_joined([*parts[:-1], replace(part, message=text)]))


def _counted_from(done: int, report: Callable[[Iterate], None]) -> Callable[[Iterate], None]:
    """Reports iterates after those of earlier parts; the first is known."""

    def report_further(iterate: Iterate) -> None:
        if iterate.iteration:
            report(replace(iterate, iteration=done + iterate.iteration))

    return report_further


def _joined(parts: list[OptimizationResult]) -> OptimizationResult:
    """The last result, with the history and the counts of all."""
    history, done = list(parts[0].history), parts[0].iterations
    for part in parts[1:]:
        history += [
            replace(iterate, iteration=done + iterate.iteration) for iterate in part.history if iterate.iteration
        ]
        done += part.iterations
    counts = {
        name: sum(getattr(part, name) for part in parts) for name in ("analyses", "gradient_evaluations", "failures")
    }
    reasons = counted(pair for part in parts for pair in part.reasons.items())
    return replace(parts[-1], history=history, iterations=done, reasons=reasons, **counts)


def with_many_failures(result: OptimizationResult) -> OptimizationResult:
    """The result with the status "many_failures" where more than a tenth of its evaluations failed."""
    if not result.failing_text or result.status in ENDED:
        return result
    message = f"{result.failing_text}; else {result.status.replace('_', ' ')}: {result.message}"
    return replace(result, status="many_failures", message=message)
