"""An optimization whose steps are chosen by the errors of its responses, beside one of as many steps as that ends with.

chosen_steps_ratio  processor time of the first over that of the second: the five-bar robot, MMFD

The first chooses steps at the start, once more on its way and for its last iterations (docs/how-to/errors.md).
"""

from __future__ import annotations

import time

import torchmbd as mbd
from experiments.benchmark.cases import compilation
from experiments.benchmark.report import Grid, Result, Settings
from experiments.models import five_bar
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.optimization import OptimizationResult

ITERATIONS = (6, 20)  # of the optimizer
FIGURE = 20
QUICK = 30  # given steps of a quick run, whose one iteration has no others


def chosen_steps(settings: Settings) -> Result:
    """See the module header."""
    figures: dict[str, float | None] = {"chosen_steps_ratio": None}
    if not settings.quick and unavailable() is not None:
        return Result(figures)
    rows = []
    with compilation(not settings.quick):
        if not settings.quick:
            five_bar.problem(QUICK).evaluate(five_bar.problem(QUICK).start[None], True)  # compiles
        for iterations in (1,) if settings.quick else ITERATIONS:
            by_errors, first = _run(QUICK if settings.quick else None, iterations)
            steps = len(first.motion.t) - 1
            fixed, second = _run(steps, iterations)
            motions = [first.analyses, second.analyses]
            rows.append([iterations, steps, *motions, by_errors, fixed, by_errors / fixed, first.value, second.value])
            if iterations == FIGURE:
                figures["chosen_steps_ratio"] = by_errors / fixed
    columns = ["iterations", "steps", "motions", "given", "s", "given", "ratio", "value", "given"]
    return Result(figures, [Grid("steps chosen by errors, and given ones, processor seconds", columns, rows)])


def _run(steps: int | None, iterations: int) -> tuple[float, OptimizationResult]:
    """Processor time [s] and result of an optimization."""
    start = time.process_time()
    result = mbd.optimize(five_bar.problem(steps), method="mmfd", max_iterations=iterations)
    return time.process_time() - start, result
