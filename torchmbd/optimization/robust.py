"""Robust design: what a design does on average, or at worst, when its variables are made within tolerances.

    delta in [-d, d]                        tolerance of every variable, uniform (d = 0: made exactly)

    expected   E f = sum_i sum_k w_k f(x + s_k d_i e_i) - (n - 1) f(x)          2n + 1 designs
               s = -sqrt(3/5), 0, sqrt(3/5),   w = 5/18, 8/18, 5/18             Gauss, exact to degree 5 in each variable
    worst      min beta   subject to   f(x + d corner) - beta <= 0              2^n designs, the corners of the box

The worst case of a function that is convex within the tolerances lies at a corner. Several corners tie at its optimum: the
extra variable beta, the last (extra_variable.py), keeps their gradients apart, and the multipliers tell which of them matter.
Constraints hold at all designs looked at; with "expected" each of them also at the corner that it rises to most steeply,
located anew around every design by the designs on the axes: c(x) + sum_i d_i |dc/dx_i|, with the curvature along that way.
Designs looked at are batches with their exact gradients, so the gradients of criteria and constraints are exact too.

Not accounted for in E: products of the even powers of two variables, of order d^4. Bounds are narrowed by d, but for variables
that repeat themselves (ply angles), whose neighbors beyond a bound are simulated.
Source: Rahman and Xu, A univariate dimension-reduction method for multi-dimensional integration in stochastic mechanics,
Probabilistic Engineering Mechanics 19 (2004) 393-408. Checked in tests/optimization/test_robust.py.
"""

from __future__ import annotations

import copy
from itertools import product
from typing import Any

import numpy as np

from torchmbd.errors import InputError, unknown
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.optimization.api import checked_box
from torchmbd.optimization.extra_variable import ExtraVariable
from torchmbd.optimization.optimizer import Evaluation, NonlinearProgram, as_numbers, require_few, require_inside

KINDS = ("expected", "worst")
NODE, OUTER = np.sqrt(0.6), 5.0 / 18.0  # of the Gauss rule of three points on [-1, 1], weights of sum one
BETA = "beta"
MAX_CORNERS = 4096


class RobustProblem(FixedArguments):
    """`problem` with its criterion replaced by its mean or its worst case over a tolerance. It is a problem too.

    problem     as `optimize` takes it; without equalities
    tolerance   half the width of the box around a design [n], or one number for all variables, in their unit
    kind        "expected" or "worst"; "worst" adds the variable beta, 1 at the start, which rises with the worst case

    >>> energy = mbd.Integral(mbd.StrainEnergy("arm"))
    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-90, 90]))
    >>> robust = mbd.optimization.RobustProblem(problem, mbd.deg(2.5))  # plies are laid up to within 2.5 degrees
    >>> [mean], [given] = (p.evaluate(p.start[None], False) for p in (robust, problem))
    >>> bool(abs(mean.objective / given.objective - 1.0) < 0.05)
    True
    """

    def __init__(self, problem: NonlinearProgram, tolerance: Any, kind: str = "expected") -> None:
        if not isinstance(kind, str) or kind not in KINDS:
            raise unknown("kind", kind, KINDS)
        if len(getattr(problem, "equalities", ())):
            state, allowed = (
                "has equalities, which the designs within a tolerance cannot all satisfy",
                "must have inequalities alone",
            )
            raise InputError("problem", problem, allowed, state=state)
        if kind == "expected" and getattr(problem, "has_extra_variable", False):
            state, allowed = "is 'expected', but the objective is the largest of several rows", "'worst'"
            raise InputError("kind", kind, allowed, state=state)
        start, lower, upper = checked_box(problem)
        self.period = np.asarray(getattr(problem, "period", np.zeros(start.size)), dtype=float)
        d = as_numbers("tolerance", tolerance)
        if d.shape not in ((), start.shape) or not (np.isfinite(d).all() and (d >= 0.0).all() and d.any()):
            allowed = f"a number, or {start.size} numbers, not negative and not all zero"
            raise InputError("tolerance", tolerance, allowed)
        d = np.array(np.broadcast_to(d, start.shape))
        for name, tolerated, low, high in zip(problem.names, d, lower, upper, strict=True):
            if 0.0 < high - low < 2.0 * tolerated:  # a constant may have a tolerance
                allowed, noun = "at most half the distance of the bounds", f"tolerance of {name}"
                raise InputError(("tolerance", name), float(tolerated), allowed, noun=noun, shown=f"{tolerated:g}")
        if getattr(problem, "has_extra_variable", False):
            d[-1] = 0.0  # it is no design variable
        inside = np.where(self.period > 0.0, 0.0, d)
        self.names, self.lower, self.upper = list(problem.names), lower + inside, upper - inside
        require_inside("start (inside the bounds by tolerance)", self.names, self.lower, start, self.upper)
        self.problem, self.kind, self.start = problem, kind, start
        self.tolerance = d
        size = int(np.count_nonzero(d))
        require_few("tolerance", tolerance, "tolerance", size, "tolerance = 0 of variables that matter less")
        self.shifts, self.weights = _expected(d) if kind == "expected" else _corners(d)
        self.has_extra_variable = kind == "worst"
        self.extra = ExtraVariable(0)
        if kind == "worst":
            self.extra = ExtraVariable.at(self._at_corners, start, self.lower, self.upper)
            self.names = [*self.names, BETA]
            self.start, self.period = np.append(start, 1.0), np.append(self.period, 0.0)
            self.lower, self.upper = np.append(self.lower, -np.inf), np.append(self.upper, np.inf)

    def _at_corners(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return objectives [k] and their gradients [k, n] at the corners around a design."""
        around = self.problem.evaluate(x + self.shifts, True)
        failed = next((e.status for e in around if not e.ok), None)
        if failed is not None:
            state, allowed = f"has the worst case {failed}", "a design that can be evaluated within tolerances"
            raise InputError("start", allowed=allowed, state=state)
        return np.array([e.objective for e in around]), np.array([e.objective_gradient for e in around])

    @property
    def simulations(self) -> int:
        """Number of simulations that one evaluation needs, without those of corners where constraints are largest."""
        return len(self.shifts) * getattr(self.problem, "simulations", 1)

    def design(self, x: np.ndarray) -> np.ndarray:
        """The design [n] of a point of this problem, without beta."""
        return x[: self.shifts.shape[1]]

    @property
    def coarse(self) -> RobustProblem | None:
        """A less accurate problem for the first half of a search; None: there is none."""
        return self.over(getattr(self.problem, "coarse", None))

    def refined(self, x: np.ndarray) -> RobustProblem | None:
        """A problem as accurate as the nominal design of a point [n] requires; None: this problem is accurate enough."""
        refine = hasattr(type(self.problem), "refined")
        return self.over(self.problem.refined(self.design(x))) if refine else None  # type: ignore[attr-defined]

    @property
    def chooses_steps(self) -> bool:
        """True if the problem chooses the number of steps, because none was given."""
        return hasattr(type(self.problem), "at_steps") and self.problem.chooses_steps  # type: ignore[attr-defined]

    @property
    def steps(self) -> int | None:
        """Steps of all motions; None if the problem has no motions, or if its start cannot be simulated."""
        return getattr(self.problem, "steps", None)

    def at_steps(self, steps: int) -> RobustProblem:
        """Return the problem whose motions have another number of steps."""
        other = self.over(self.problem.at_steps(steps))  # type: ignore[attr-defined]
        assert other is not None
        return other

    @property
    def accuracy(self) -> str:
        """The steps with which designs are evaluated."""
        return getattr(self.problem, "accuracy", "")

    def over(self, problem: Any) -> RobustProblem | None:
        """The same tolerances with another problem that evaluates the same designs; None for None."""
        if problem is None:
            return None
        other = copy.copy(self)
        vars(other)["problem"] = problem
        return other

    def motion(self, x: np.ndarray) -> Any:
        """Motion of the nominal design."""
        return self.problem.motion(self.design(x))  # type: ignore[attr-defined]

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n], all their neighbors in one batch, all their steepest corners in another."""
        count, n = self.shifts.shape
        evaluations = self.problem.evaluate((X[:, None, :n] + self.shifts).reshape(-1, n), gradients)
        around = [evaluations[k * count : (k + 1) * count] for k in range(len(X))]
        corners, rows = zip(*(self._steepest(x[:n], group) for x, group in zip(X, around, strict=True)), strict=True)
        designs = np.concatenate(corners)
        ends = iter(self.problem.evaluate(designs, gradients) if len(designs) else [])
        there = [[next(ends) for _ in corner] for corner in corners]
        return [self._combined(*arguments) for arguments in zip(X, around, there, rows, strict=True)]

    def with_least_bound(self, x: np.ndarray, evaluation: Evaluation) -> tuple[np.ndarray, Evaluation]:
        """The point [n] with the smallest beta that satisfies its rows, so that its objective is its worst case."""
        return self.extra.tightened(x, evaluation)

    def _steepest(self, x: np.ndarray, evaluations: list[Evaluation]) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners [k, n] that constraints rise to most steeply, and for each constraint which of them [m]."""
        if self.kind == "worst" or not all(e.ok for e in evaluations):
            return np.zeros((0, x.size)), np.zeros(0, dtype=int)
        c = np.array([np.atleast_1d(e.constraints) for e in evaluations])
        signs = np.zeros((c.shape[1], x.size))
        signs[:, np.flatnonzero(self.tolerance)] = np.where(c[2::2] >= c[1::2], 1.0, -1.0).T
        distinct, rows = np.unique(signs, axis=0, return_inverse=True)
        return x + distinct * self.tolerance, rows.reshape(-1)

    def _combined(
        self, x: np.ndarray, around: list[Evaluation], corners: list[Evaluation], rows: np.ndarray
    ) -> Evaluation:
        """Return the evaluation of x; constraint j holds at all designs around it and at the corner `rows[j]`."""
        failed = next((e.status for e in (*around, *corners) if not e.ok), None)
        if failed is not None:
            return Evaluation.failure(f"within its tolerances: {failed}")
        f = np.array([e.objective for e in around])
        held = [(e, slice(None)) for e in around] + [(corners[k], slice(j, j + 1)) for j, k in enumerate(rows)]
        c = np.concatenate([np.atleast_1d(e.constraints)[part] for e, part in held])
        df = dc = None
        if all(e.objective_gradient is not None for e in around):
            df = np.array([e.objective_gradient for e in around])
            parts = [e.constraint_gradients[part] for e, part in held if e.constraint_gradients is not None]
            dc = np.concatenate(parts) if parts else np.zeros((0, df.shape[1]))
        if self.kind == "expected":
            return Evaluation(float(self.weights @ f), c, None if df is None else self.weights @ df, dc)
        all_slopes = None if df is None or dc is None else np.concatenate([df, dc])[None]
        values, slopes = self.extra.stated(np.concatenate([f, c])[None], all_slopes, x[-1:])
        if slopes is None:
            return Evaluation(float(values[0, 0]), values[0, 1:])
        return Evaluation(float(values[0, 0]), values[0, 1:], slopes[0, 0], slopes[0, 1:])


def _expected(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shifts [k, n] and weights [k]; only variables with a tolerance are moved."""
    moved = np.flatnonzero(d)
    shifts = np.zeros((1 + 2 * moved.size, d.size))
    for k, sign in enumerate((-1.0, 1.0), start=1):
        shifts[np.arange(k, len(shifts), 2), moved] = sign * NODE * d[moved]
    return shifts, np.array([1.0 - 2.0 * OUTER * moved.size, *[OUTER] * (2 * moved.size)])


def _corners(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [2^n, n] of the box; they have equal rights."""
    moved = np.flatnonzero(d)
    if 2**moved.size > MAX_CORNERS:
        state = f"of {moved.size} variables has {2**moved.size} combinations of lower and upper limits"
        raise InputError("tolerance", allowed=f"must have at most {MAX_CORNERS}", state=state)
    corners = np.zeros((2**moved.size, d.size))
    corners[:, moved] = np.array(list(product((-1.0, 1.0), repeat=moved.size))) * d[moved]
    return corners, np.ones(len(corners))
