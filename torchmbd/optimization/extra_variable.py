"""The extra variable of a min-max problem, last in x: minimize unit * x[-1], the first rows are f_i / unit - x[-1] <= 0.

A method varies it like any other variable, so at its iterates it may be above max f_i / unit, or below. Reports hold the
maximum itself.
Checked in tests/optimization/test_extra_variable.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchmbd.optimization.optimizer import Evaluation

SAME = 1e-12  # a smaller change of the extra variable is rounding


def with_least_extra_variable(
    x: np.ndarray, evaluation: Evaluation, rows: int, unit: float, lower: float, upper: float
) -> tuple[np.ndarray, Evaluation]:
    """Return the design [n] with the least extra variable that its first `rows` constraints and bounds allow, evaluated.

    Design and evaluation are returned unchanged where `rows` is 0, the evaluation failed, or the variable is the least.
    """
    if not rows or not evaluation.ok:
        return x, evaluation
    least = min(max(x[-1] + float(evaluation.constraints[:rows].max()), lower), upper)
    moved = float(x[-1]) - least
    if abs(moved) <= SAME * max(1.0, abs(least)):
        return x, evaluation
    constraints = evaluation.constraints.copy()
    constraints[:rows] += moved
    value = evaluation.objective - moved * unit
    return np.append(x[:-1], least), replace(evaluation, objective=value, constraints=constraints)
