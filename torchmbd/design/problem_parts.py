"""Parts of a problem: the objective with its sign, the constraints, the numbers of the initial design, evaluations.

Checked in tests/design/test_problem.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from torchmbd.design.response import Constraint, Measure
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import list_of
from torchmbd.optimization import Evaluation
from torchmbd.results.motion_data import OK


class Reference(NamedTuple):
    """Measures, limits and scales of a problem, with numbers for all that refers to the initial design.

    measures  objective, then one for each constraint
    unit      the extra variable of a min-max problem is multiplied by it
    limits    c of every row of the constraints [m]
    scale     divisor of g - c of each row: positive, or negative for lower limits [m]
    """

    measures: list[Measure]
    unit: float
    limits: np.ndarray
    scale: np.ndarray


def constraints_of(subject_to: Any) -> list[Constraint]:
    """A constraint, or a list of them, as a list; InputError names an entry that is no constraint."""
    constraints = [subject_to] if isinstance(subject_to, Constraint) else subject_to
    return list_of("subject_to", constraints, Constraint, "constraints, such as Max(...) <= 'initial'")


def stated_objective(minimize: Any, maximize: Any) -> tuple[Measure, float]:
    """The measure that is minimized or maximized, and its sign in the minimization: 1, or -1 for `maximize`."""
    if minimize is not None and maximize is not None:
        raise InputError(f"minimize is {minimize!r} and maximize is {maximize!r}; allowed: one of them")
    if minimize is None and maximize is None:
        raise InputError("'minimize' of Problem is missing; allowed: a measure, here or as 'maximize'")
    name, measure = ("minimize", minimize) if maximize is None else ("maximize", maximize)
    if not isinstance(measure, Measure):
        raise InputError(f"{name} is {measure!r}; allowed: a measure, such as Integral(StrainEnergy('rod'))")
    if maximize is not None and measure.rows > 1:
        raise InputError(f"maximize is {measure!r}, of {measure.rows} rows; allowed: a measure of one number")
    return measure, 1.0 if maximize is None else -1.0


def largest_row(measure: Measure, motion: Trajectory) -> float:
    """The largest row of a measure in the first lane of a motion."""
    return float(measure.value(motion)[0].max())


def scale_of(constraint: Constraint, limit: float) -> float:
    """The divisor of g - limit: positive, or negative for a lower limit."""
    size = constraint.scale or abs(limit) or 1.0
    return -size if constraint.kind == "at_least" else size


def evaluation_of(status: str, values: np.ndarray, gradients: np.ndarray | None, rows: int) -> Evaluation:
    """The evaluation of a design from its status, objective and constraints [1 + rows], and their gradients [1 + rows, n]."""
    if status == OK and not np.isfinite(values).all():
        status = "failed: a response is not finite"
    elif status == OK and gradients is not None and not np.isfinite(gradients).all():
        status = "failed: the gradient of a response is not finite"
    if status != OK:
        return Evaluation.failure(status, rows)
    if gradients is None:
        return Evaluation(float(values[0]), values[1:])
    return Evaluation(float(values[0]), values[1:], gradients[0], gradients[1:])


def with_extra_variable(
    values: np.ndarray, slopes: np.ndarray | None, peaks: int, beta: np.ndarray, unit: float
) -> tuple[np.ndarray, np.ndarray | None]:
    """Rows and gradients of the problem with the objective beta y_0; eqs. (19), (20).

    values [lanes, peaks + m] and slopes [lanes, peaks + m, n]   of the rows of the objective, then of the constraints
    beta   the extra variable [lanes];   unit   y_0
    """
    values[:, :peaks] = values[:, :peaks] / unit - beta[:, None]
    values = np.concatenate([beta[:, None] * unit, values], 1)
    if slopes is None:
        return values, None
    lanes, m, n = slopes.shape
    full = np.zeros((lanes, m + 1, n + 1))
    full[:, 1:, :n] = slopes
    full[:, 1 : 1 + peaks, :n] /= unit
    full[:, 1 : 1 + peaks, n] = -1.0
    full[:, 0, n] = unit
    return values, full
