"""The end of a study whose variables take steps, `step: 5`: the best design on them (branch_and_bound.py).

It begins where the starts of the study ended, for nothing: what they evaluated is known. Then designs on the steps are
searched until no neighbor of the best is better.
Checked in tests/study/test_discrete_polish.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.optimization import DiscreteResult, MultistartResult, optimize_discrete
from torchmbd.study.journal import Journal, percent
from torchmbd.study.settings import StudySettings


def lay(
    study: StudySettings,
    target: Any,
    points: np.ndarray,
    options: dict[str, Any],
    relaxed: MultistartResult,
    journal: Journal,
    console: Console,
) -> DiscreteResult:
    """Search the designs on the steps from the start designs [count, n]; print and file the best of them."""
    limits = {"max_iterations": study.max_iterations, **options}
    if not console.is_terminal:
        console.print("searching designs on the steps")
    with console.status("searching designs on the steps"):
        found = optimize_discrete(target, study.increments, study.method, list(points), **limits)
    best, above = found.best, relaxed.best
    journal.summary({}, {"status_on_steps": found.status, "message_on_steps": found.message})
    if best is None:
        console.print(f"on the steps: {escape(found.message)}", soft_wrap=True)
        return found
    rise = (
        ""
        if above is None
        else f", {max(0.0, -percent(above.value, best.value)):.2g} % worse than the best of the table"
    )
    console.print(
        f"on the steps: {study.columns.sentence(best.x)}, objective {study.sign * best.value:.6g}{rise}; "
        f"{escape(found.message)}",
        soft_wrap=True,
        highlight=False,
    )
    numbers = {"objective": study.sign * best.value, "violation": best.violation, **journal.shown(best.x)}
    numbers |= {} if above is None else {"relaxed_objective": study.sign * above.value}
    journal.summary(numbers, {})
    journal.design(best.x)
    return found
