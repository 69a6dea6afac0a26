"""Discrete search at the end of a study whose variables take steps (`step: 5`), see branch_and_bound.py.

It begins with the ends of the starts of the study, whose evaluations are on disk. Then designs on the steps are searched until
no neighbor of the best one is better.
Checked in tests/study/test_discrete_polish.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.optimization import DiscreteResult, MultistartResult, optimize_discrete
from torchmbd.study.record.journal import Journal, percent
from torchmbd.study.settings import StudySettings


def search_on_steps(
    study: StudySettings,
    target: Any,
    points: np.ndarray,
    options: dict[str, Any],
    relaxed: MultistartResult,
    journal: Journal,
    console: Console,
) -> DiscreteResult:
    """Search the designs on the steps from the start designs `points` [count, n]; print and track the best of them.

    target   the problem that optimizers see
    options  of multistart and of the method
    relaxed  result of the starts without steps
    """
    limits = {"max_iterations": study.max_iterations, **options}
    if not console.is_terminal:
        console.print("searching designs on the steps")
    with console.status("searching designs on the steps"):
        result = optimize_discrete(target, study.increments, study.method, list(points), **limits)
    best, continuous = result.best, relaxed.best
    journal.summary({}, {"status_on_steps": result.status, "message_on_steps": result.message})
    if best is None:
        console.print(f"on the steps: {escape(result.message)}", soft_wrap=True)
        return result
    rise = ""
    if continuous is not None:
        rise = f", {max(0.0, -percent(continuous.value, best.value)):.2g} % worse than the best of the table"
    console.print(
        f"on the steps: {study.columns.sentence(best.x)}, objective {study.sign * best.value:.6g}{rise}; "
        f"{escape(result.message)}",
        soft_wrap=True,
        highlight=False,
    )
    journal.summary({} if continuous is None else {"relaxed_objective": study.sign * continuous.value}, {})
    journal.outcome(best.x, best.value, best.violation)
    journal.design(best.x)
    return result
