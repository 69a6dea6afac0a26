"""The extra variable beta of a min-max problem, last in x: the largest of several rows y_k becomes a smooth problem.

    minimize y_0 + u (beta - 1)   subject to   (y_k - y_0) / u + 1 - beta <= 0              eqs. (19), (20)

    y_0   largest row of the initial design, where beta is 1
    u     |y_0|, kept near the change of the rows (`unit_of`): neither a sign, nor zero, nor a constant part matters

With a positive y_0 these are the rows y_k / y_0 - beta <= 0 and the objective beta y_0 of the paper. beta has no lower bound.
A method varies it like any other variable, so at its iterates it may be above or below the largest row. Reports hold the
largest row itself.
Checked in tests/optimization/test_extra_variable.py, tests/contracts/test_invariance.py.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from torchmbd.errors import InputError, SimulationFailure
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.units import first_order_change, needs_neighbor, neighbor, unit_of, variable_scale

Rows = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
MOST = 10.0  # times the change of the rows: u is |y_0| up to there, as in the paper
SAME = 1e-12  # a smaller change of the extra variable is rounding


@dataclass(frozen=True)
class ExtraVariable:
    """The extra variable of the objective's first `rows` rows.

    rows    number of rows y_k, 0: the objective is one number, and there is no extra variable
    origin  y_0, in the unit of the objective
    unit    u, positive, in the unit of the objective
    upper   upper bound of beta
    """

    rows: int
    origin: float = 0.0
    unit: float = 1.0
    upper: float = np.inf

    @classmethod
    def at(
        cls, rows: Rows, start: np.ndarray, lower: np.ndarray, upper: np.ndarray, most: float = np.inf
    ) -> ExtraVariable:
        """The extra variable of a problem from the initial design.

        rows                 values [rows] and slopes [rows, n] of a design [n]; called at the start, and near it if need be
        start, lower, upper  of the design variables [n]
        most                 upper bound of beta
        """
        size = np.maximum(np.abs(start), variable_scale(start, lower, upper))
        values, slopes = rows(start)
        origin, change = float(values.max()), max(first_order_change(slope, size) for slope in slopes)
        if needs_neighbor(origin, change):
            with suppress(InputError, SimulationFailure):  # it is only to tell the unit
                _, slopes = rows(neighbor(start, lower, upper, size))
                change = max(change, *(first_order_change(slope, size) for slope in slopes))
        return cls(len(values), origin, unit_of(origin, change, MOST), most)

    def of_largest(self, row: float) -> float:
        """beta of a design whose largest row this is."""
        return 1.0 + (row - self.origin) / self.unit

    def stated(
        self, values: np.ndarray, slopes: np.ndarray | None, beta: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Objective and rows [lanes, 1 + rows + m] with slopes [lanes, 1 + rows + m, n + 1] by design variables and beta.

        values  [lanes, rows + m] and slopes [lanes, rows + m, n], of the rows y_k and of the constraints
        beta    [lanes]
        """
        moved = beta - 1.0
        rows = (values[:, : self.rows] - self.origin) / self.unit - moved[:, None]
        objective = self.origin + self.unit * moved
        stated = np.concatenate([objective[:, None], rows, values[:, self.rows :]], 1)
        if slopes is None:
            return stated, None
        lanes, m, n = slopes.shape
        full = np.zeros((lanes, m + 1, n + 1))
        full[:, 1:, :n] = slopes
        full[:, 1 : 1 + self.rows, :n] /= self.unit
        full[:, 1 : 1 + self.rows, n] = -1.0
        full[:, 0, n] = self.unit
        return stated, full

    def tightened(self, x: np.ndarray, evaluation: Evaluation) -> tuple[np.ndarray, Evaluation]:
        """The design [n] with the least extra variable that its rows and `upper` allow, evaluated.

        Both are returned unchanged where there is no extra variable, the evaluation failed, or the variable is the least.
        """
        if not self.rows or not evaluation.ok:
            return x, evaluation
        least = min(x[-1] + float(evaluation.constraints[: self.rows].max()), self.upper)
        moved = float(x[-1]) - least
        if abs(moved) <= SAME * max(1.0, abs(least)):
            return x, evaluation
        constraints = evaluation.constraints.copy()
        constraints[: self.rows] += moved
        value = evaluation.objective - moved * self.unit
        return np.append(x[:-1], least), replace(evaluation, objective=value, constraints=constraints)
