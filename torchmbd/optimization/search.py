"""One start as an optimizer sees it: scaled, cached, counted, and safe against failed evaluations.

    y = x / scale,   scale = |x_start|, or the bound range where |x_start| is tiny        (section 5.2 of the paper)
    f = objective / |objective(start)|

A search does not know where designs are evaluated: `evaluate_batch` is `problem.evaluate` in `optimize`; in `multistart` it
hands them to the thread that evaluates the designs of all starts together (multistart/batched.py).
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any, Self

import numpy as np

from torchmbd.errors import InputError
from torchmbd.optimization.batch import wrong_count
from torchmbd.optimization.cache import MemoryStore
from torchmbd.optimization.kkt import KuhnTucker, kuhn_tucker
from torchmbd.optimization.optimizer import Evaluation, Iterate, largest_violation, rank, require_range
from torchmbd.optimization.units import first_order_change, needs_neighbor, neighbor, unit_of

TIMES = 1e-3, 1e9  # limits of time [s]
EvaluateBatch = Callable[[np.ndarray, bool], list[Evaluation]]  # designs [k, n] in one batch
Report = Callable[[Iterate], None]
Tighten = Callable[[np.ndarray, Evaluation], tuple[np.ndarray, Evaluation]]  # Problem.with_least_bound


class Interrupted(BaseException):
    """Raised inside a method to end it when the user stops the study. Not an Exception: no method may swallow it."""


class OutOfAnalyses(BaseException):
    """Raised inside a method to end it when its start has had its limit of analyses. Not an Exception, as above."""


class OutOfTime(BaseException):
    """Raised inside a method to end it when the limit of time is reached. Not an Exception, as above."""


def deadline_of(max_time: float | None) -> float:
    """When a search that begins now must end, by time.monotonic() [s]; InputError for a limit that is not a time."""
    return math.inf if max_time is None else time.monotonic() + require_range("max_time", max_time, *TIMES)


def is_over(deadline: float) -> bool:
    """True if a deadline has passed."""
    return time.monotonic() > deadline


class Search:
    """The problem of one start in scaled variables `y`; `evaluate` never repeats a simulation."""

    def __init__(
        self,
        evaluate_batch: EvaluateBatch,
        start: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        *,
        scale: np.ndarray | None = None,
        equalities: np.ndarray | None = None,
        feasibility: float = 1e-6,
        eager_gradients: bool = True,
        max_analyses: int | None = None,
        deadline: float = math.inf,
        index: int = 0,
        report: Report | None = None,
        tighten: Tighten | None = None,
        has_extra_variable: bool = False,
        accuracy: str = "",
    ) -> None:
        self.scale = np.ones(start.size) if scale is None else scale
        self.scaled = scale is not None
        self.objective_scale, self.objective_offset = 1.0, 0.0  # scaled f: (f - offset) / scale
        self.x_lower, self.x_upper = lower, upper
        self.lower, self.upper = lower / self.scale, upper / self.scale
        self.start = start / self.scale
        self.feasibility = feasibility
        self.eager_gradients = eager_gradients
        self.max_analyses, self.deadline = max_analyses, deadline
        self.index, self.has_extra_variable, self.accuracy = index, has_extra_variable, accuracy
        self.equality = np.zeros(0, dtype=bool)
        self.history: list[Iterate] = []
        self.analyses = self.gradient_evaluations = 0
        self.reasons: Counter[str] = Counter()  # of failed evaluations
        self._evaluate_batch, self._report, self._tighten = evaluate_batch, report, tighten
        self.equalities = np.zeros(0, dtype=int) if equalities is None else np.asarray(equalities, dtype=int)
        self._cache = MemoryStore[Evaluation]()  # physical units
        self._ranks: dict[bytes, tuple[tuple[bool, float], np.ndarray]] = {}  # with y, of what succeeded

    @classmethod
    def of(cls, problem: Any, evaluate_batch: EvaluateBatch, *box: np.ndarray, **settings: Any) -> Self:
        """Return a search of a problem, with the equalities and the extra variable that the problem may have.

        box       start, lower, upper [n]
        settings  keyword arguments of the class
        """
        equalities, tighten = getattr(problem, "equalities", None), getattr(problem, "with_least_bound", None)
        settings |= {"has_extra_variable": bool(getattr(problem, "has_extra_variable", False))}
        settings |= {"accuracy": getattr(problem, "accuracy", "")}
        return cls(evaluate_batch, *box, equalities=equalities, tighten=tighten, **settings)

    @property
    def size(self) -> int:
        return self.start.size

    @property
    def failures(self) -> int:
        """Number of evaluations that failed."""
        return self.reasons.total()

    def refuse_equalities(self, method: str) -> None:
        """Raise InputError if the problem has equalities, for methods that stay inside the feasible region."""
        if self.equalities.size:
            raise InputError(
                "method",
                method,
                allowed="a method that takes equalities",
                shown=repr(method),
                state=f"takes inequalities alone, but constraints {self.equalities.tolist()} are equalities",
                hint="method='slsqp', or two opposite inequalities with a tolerance for each",
            )

    def physical(self, y: np.ndarray) -> np.ndarray:
        """Return x [n] of scaled y, inside the bounds to the last digit."""
        return np.clip(np.asarray(y, dtype=float) * self.scale, self.x_lower, self.x_upper)

    def begin(self, gradients: bool = True) -> Evaluation:
        """Evaluate the start and record it; at the first call, set the scale of the objective by it."""
        x = self.physical(self.start)
        first = self._evaluate_physical(x, gradients)
        if first.ok and not self.history:
            self._measure_objective(x, first)
            self._rank_design(self.start, first)
        known = self.physical(self.tightened(self.start))
        if not any(np.array_equal(iterate.x, known) for iterate in self.history):
            self.record(self.start)
        return self._scaled(first)

    def set_objective_unit(self, change: float) -> None:
        """Set scale and offset of the objective by what the variables change: its unit and constant part do not matter."""
        if not self.scaled:
            return
        f = self.physical_objective(self.start)
        self.objective_scale = unit_of(f, change)
        # A constant part is left out, so that tolerances relative to the objective are relative to what changes.
        self.objective_offset = f - float(np.clip(f, -self.objective_scale, self.objective_scale))

    def _measure_objective(self, x: np.ndarray, first: Evaluation) -> None:
        """Set the unit of the objective by the start x [n], and by a neighbor where the start does not tell."""
        f, change = first.objective, self._change(x, first)
        if self.scaled and first.objective_gradient is not None and needs_neighbor(f, change):
            with contextlib.suppress(OutOfAnalyses):
                near = self.physical(self.neighbor)
                change = max(change, self._change(near, self._evaluate_physical(near, True)))
        self.set_objective_unit(change)

    def _change(self, x: np.ndarray, evaluation: Evaluation) -> float:
        """Return the first-order change of the objective at x [n] by a change of a variable by its own size."""
        if evaluation.objective_gradient is None:
            return 0.0
        return first_order_change(evaluation.objective_gradient, np.maximum(np.abs(x), self.scale))

    @property
    def neighbor(self) -> np.ndarray:
        """A design [n] (scaled) near the start, without its symmetries."""
        return neighbor(self.start, self.lower, self.upper, np.maximum(np.abs(self.start), 1.0))

    def evaluate(self, y: np.ndarray, gradients: bool = False) -> Evaluation:
        """Return objective and constraints at `y` (scaled), with gradients on request or if eager; cached."""
        evaluation = self._evaluate_physical(self.physical(y), gradients or self.eager_gradients)
        self._rank_design(y, evaluation)
        return self._scaled(evaluation)

    def prefetch(self, Y: Sequence[np.ndarray], gradients: bool = True) -> None:
        """Evaluate several designs (scaled) in one batch; `evaluate` then takes them from the cache."""
        X = {x.tobytes(): x for x in map(self.physical, Y)}
        self._fetch([x for key, x in X.items() if self._cache.lookup(key, gradients) is None], gradients)

    def evaluate_known(self, y: np.ndarray) -> Evaluation:
        """Return the cached evaluation at `y`; a failed one if there is none."""
        known = self._cache.lookup(self.physical(y).tobytes(), gradients=False)
        return self._scaled(Evaluation.failure("never evaluated") if known is None else known)

    def record(self, y: np.ndarray) -> None:
        """Add `y`, evaluated before, to the history as the next accepted iterate, and report it."""
        x = self.physical(self.tightened(y))
        evaluation = self._cached(x)
        violation = self.violation(evaluation) if evaluation.ok else float("nan")
        iterate = Iterate(
            start=self.index,
            iteration=len(self.history),
            x=x,
            objective=evaluation.objective,
            violation=violation,
            constraints=evaluation.constraints,
            analyses=self.analyses,
            status=evaluation.status,
            accuracy=self.accuracy,
        )
        self.history.append(iterate)
        if self._report is not None:
            self._report(iterate)

    def physical_objective(self, y: np.ndarray) -> float:
        """Return the objective at `y` (scaled, evaluated before), in its own unit; nan where it failed."""
        known = self._cache.lookup(self.physical(y).tobytes(), gradients=False)
        return float("nan") if known is None else known.objective

    def violation(self, evaluation: Evaluation) -> float:
        """Return the largest violation of a constraint, 0 where all are satisfied."""
        return largest_violation(evaluation.constraints, self.equality)

    def rank(self, evaluation: Evaluation) -> tuple[bool, float]:
        """Return the sort key of a design, the best first, as `rank` of optimizer.py."""
        return rank(evaluation.objective, self.violation(evaluation), self.feasibility)

    def kuhn_tucker(self, evaluation: Evaluation, y: np.ndarray) -> KuhnTucker:
        """Return multipliers and Kuhn-Tucker residual of `y`, whose evaluation carries gradients."""
        return kuhn_tucker(evaluation, y, self.lower, self.upper, self.equality, self.feasibility)

    def violated(self, evaluation: Evaluation) -> list[int]:
        """Return the indices of the constraints that are not satisfied."""
        c = evaluation.constraints
        return np.flatnonzero(np.where(self.equality, np.abs(c), c) > self.feasibility).tolist()

    @property
    def best(self) -> np.ndarray | None:
        """Scaled y of the best design seen (feasible and lowest, else least infeasible); None if none succeeded."""
        return min(self._ranks.values(), key=itemgetter(0))[1] if self._ranks else None

    def nearly_feasible(self, most: float) -> list[np.ndarray]:
        """Return the designs seen (scaled) that are not feasible, but violate no constraint by more than `most`."""
        return [y for (infeasible, number), y in self._ranks.values() if infeasible and number <= most]

    def nearest(self, y: np.ndarray, count: int) -> list[tuple[np.ndarray, Evaluation]]:
        """Return the other designs (scaled) that were evaluated with gradients, the nearest to y first."""
        x = self.physical(y)
        known = [
            (other / self.scale, self._scaled(evaluation))
            for other, evaluation in self._cache.entries.values()
            if evaluation.ok and evaluation.differentiated and not np.array_equal(other, x)
        ]
        return sorted(known, key=lambda pair: float(np.linalg.norm(pair[0] - y)))[:count]

    def _rank_design(self, y: np.ndarray, evaluation: Evaluation) -> None:
        if not evaluation.ok:
            return
        y = self.tightened(y)
        x = self.physical(y)
        self._ranks[x.tobytes()] = self.rank(self._cached(x)), np.array(y, dtype=float)

    def tightened(self, y: np.ndarray) -> np.ndarray:
        """Return y (evaluated before) with the least extra variable that its rows allow; see extra_variable.py."""
        x = self.physical(y)
        if self._tighten is None or x.tobytes() not in self._cache.entries:
            return y
        least, evaluation = self._tighten(x, self._cached(x))
        if least is x:
            return y
        tightened = least / self.scale
        key = self.physical(tightened).tobytes()
        cached = self._cache.entries.get(key)
        if cached is None or (evaluation.differentiated and not cached[1].differentiated):
            self._cache.entries[key] = self.physical(tightened), evaluation
        return tightened

    def _evaluate_physical(self, x: np.ndarray, gradients: bool) -> Evaluation:
        if self._cache.lookup(x.tobytes(), gradients) is None:
            self._fetch([x], gradients)
        return self._cached(x)

    def _cached(self, x: np.ndarray) -> Evaluation:
        """Return the cached evaluation of a design x [n], in physical units."""
        return self._cache.entries[x.tobytes()][1]

    def _fetch(self, designs: list[np.ndarray], gradients: bool) -> None:
        for x in designs:
            if not np.isfinite(x).all():  # a method runs away
                self._cache.entries[x.tobytes()] = x, Evaluation.failure("the design is not finite")
        designs = [x for x in designs if np.isfinite(x).all()]
        if designs and is_over(self.deadline):
            raise OutOfTime
        remaining = len(designs) if self.max_analyses is None else max(self.max_analyses - self.analyses, 0)
        allowed = designs[:remaining]
        answers = self._evaluate_batch(np.stack(allowed), gradients) if allowed else []
        if len(answers) != len(allowed):
            raise wrong_count(answers, allowed)
        for x, answer in zip(allowed, answers, strict=True):
            with_gradients = gradients or answer.objective_gradient is not None
            evaluation = checked(answer, self.size, with_gradients)
            self.analyses += 1
            self.gradient_evaluations += with_gradients
            if evaluation.ok and self.equality.size != evaluation.constraints.size:
                self.equality = np.zeros(evaluation.constraints.size, dtype=bool)
                self.equality[self.equalities] = True
            if not evaluation.ok:
                self.reasons[evaluation.status] += 1
                self._ranks.pop(x.tobytes(), None)  # its values were evaluated before, its gradient fails
            self._cache.entries[x.tobytes()] = x, evaluation
        if len(allowed) < len(designs):
            raise OutOfAnalyses

    def _scaled(self, evaluation: Evaluation) -> Evaluation:
        if not evaluation.ok:
            return evaluation
        df, dc = evaluation.objective_gradient, evaluation.constraint_gradients
        return replace(
            evaluation,
            objective=(evaluation.objective - self.objective_offset) / self.objective_scale,
            objective_gradient=None if df is None else df * self.scale / self.objective_scale,
            constraint_gradients=None if dc is None else dc * self.scale,
        )


def checked(evaluation: Evaluation, size: int, gradients: bool) -> Evaluation:
    """Return the evaluation in the contract's shapes; numbers that are not finite make it a failure that says so."""
    if not evaluation.ok:
        return Evaluation.failure(evaluation.status)
    c = np.atleast_1d(np.asarray(evaluation.constraints, dtype=float))
    df = dc = None
    if gradients:
        if evaluation.objective_gradient is None or (c.size and evaluation.constraint_gradients is None):
            raise InputError(
                ("problem", "evaluate"),
                allowed="must return gradients, because gradients=True",
                state="returned no gradients",
            )
        df = np.asarray(evaluation.objective_gradient, dtype=float)
        dc = np.zeros((0, size)) if not c.size else np.asarray(evaluation.constraint_gradients, dtype=float)
        if df.shape != (size,) or dc.shape != (c.size, size):
            raise InputError(
                ("problem", "evaluate"),
                allowed=f"must return shapes {(size,)} and {(c.size, size)}",
                state=f"returned gradients of shape {df.shape} and {dc.shape}",
            )
    named = {"objective": evaluation.objective, "constraints": c, "objective gradient": df, "constraint gradients": dc}
    for name, numbers in named.items():
        if numbers is not None and not np.isfinite(numbers).all():
            return Evaluation.failure(f"{name} not finite")
    return Evaluation(float(evaluation.objective), c, df, dc)
