"""L-BFGS-B (limited-memory quasi-Newton steps inside bounds) for thousands of variables; constraints by augmented Lagrangians.

    L(y) = f + sum_i psi(c_i),     psi = rho / 2 (max(0, c + lambda / rho)^2 - (lambda / rho)^2)     (equalities: without max)

Every minimum of L inside the bounds gives new multipliers lambda + rho dpsi/dc; rho grows tenfold where the violation has not
fallen to a quarter, and where L falls without end, which then is minimized anew. Memory and arithmetic per step grow with the
number of variables; SLSQP's with its square and cube.
Source: scipy.optimize.minimize, method "L-BFGS-B" (Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16 (1995) 1190-1208);
E. G. Birgin and J. M. Martinez, Practical Augmented Lagrangian Methods for Constrained Optimization (2014), chapter 4.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.optimize import minimize

from torchmbd.optimization.methods.adapters import Stop, WrappedProblem, run_adapted
from torchmbd.optimization.optimizer import Ending, register, require_count, require_range
from torchmbd.optimization.search import Search

ROUNDS = 40
FIRST_TOLERANCE = 1e-2  # of the first minimum of L; a tenth of the last in each further one
LARGEST_PENALTY = 1e8
LINE_SEARCH = 60  # evaluations: where a constraint begins to count, the slope of L turns within a thousandth of a step
FAR = 10.0  # violation beyond which L counts as unbounded below, times that at the start of a round (at least 1)


@register("lbfgs")
def lbfgs(
    search: Search,
    max_iterations: int,
    *,
    gtol: float = 1e-7,
    ftol: float = 1e-14,
    memory: int = 30,
    kkt: float = 1e-3,
) -> Ending:
    """Run L-BFGS-B on one start. `gtol`, `ftol`: SciPy's; `memory`: last steps that give the curvature.

    `kkt`: Kuhn-Tucker residual of an optimum.
    """
    for name, value in {"gtol": gtol, "ftol": ftol, "kkt": kkt}.items():
        require_range(name, value, 1e-16, 1.0)
    require_count("memory", memory, 2, 1000)
    return run_adapted(search, partial(_run, gtol=gtol, ftol=ftol, memory=memory), max_iterations, kkt)


def _run(wrapped: WrappedProblem, gtol: float, ftol: float, memory: int) -> Stop:
    lagrangian, y = _Lagrangian(wrapped), wrapped.y
    tolerance, done = FIRST_TOLERANCE if lagrangian.rows.size else gtol, False

    def accepted(y: np.ndarray) -> None:
        wrapped.record(np.array(y))
        if lagrangian.diverges(y):
            raise StopIteration

    for _ in range(ROUNDS):
        result = minimize(
            lagrangian,
            y,
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(wrapped.lower, wrapped.upper, strict=True)),
            callback=accepted,
            options={
                "maxiter": wrapped.remaining + 1,
                "maxcor": memory,
                "maxls": LINE_SEARCH,
                "gtol": tolerance,
                "ftol": ftol,
            },
        )
        if lagrangian.diverges(result.x):
            if not lagrangian.stiffen():
                break
            continue
        y = result.x
        done = lagrangian.renew(y)
        if tolerance <= gtol and (done or not result.success):
            break
        tolerance = max(0.1 * tolerance, gtol)
    return Stop(y, bool(result.success and done), f"L-BFGS-B: {result.message}".lower().capitalize())


class _Lagrangian:
    """L and its gradient, with the multipliers and the penalty of the present round."""

    def __init__(self, wrapped: WrappedProblem) -> None:
        self.wrapped, self.rows = wrapped, np.arange(wrapped.search.equality.size)
        self.multipliers = np.zeros(self.rows.size)
        first = wrapped.value(wrapped.y)
        c = self._violated(first.constraints)
        size = abs(first.objective) / wrapped.unit
        self.violation = float(np.abs(c).max(initial=0.0))
        self.penalty = float(np.clip(2.0 * size / max(float(c @ c), 1e-12), 1e-2, 10.0))

    def __call__(self, y: np.ndarray) -> tuple[float, np.ndarray]:
        value = self.wrapped.value(y)
        pushed = self._forces(value.constraints)
        f = value.objective / self.wrapped.unit
        f += float(pushed @ pushed - self.multipliers @ self.multipliers) / (2.0 * self.penalty)
        if not self.wrapped.search.evaluate(y).ok:
            return f, np.zeros(y.size)
        df = self.wrapped.slope(y)
        return f, df + pushed @ self.wrapped.jacobian(y, self.rows) if self.rows.size else df

    def renew(self, y: np.ndarray) -> bool:
        """Update the multipliers; return whether y is feasible and they have not changed."""
        if not self.rows.size:
            return True
        c = self.wrapped.value(y).constraints
        pushed = self._forces(c)
        change = float(np.abs(pushed - self.multipliers).max()) / max(1.0, float(np.abs(pushed).max()))
        self.multipliers = pushed
        violation = float(np.abs(self._violated(c)).max())
        if violation > max(0.25 * self.violation, 0.1 * self.wrapped.search.feasibility):
            self.stiffen()
        self.violation = violation
        return violation <= 0.5 * self.wrapped.search.feasibility and change <= 1e-3

    def diverges(self, y: np.ndarray) -> bool:
        """True if f falls faster than the penalty grows."""
        far = FAR * max(1.0, self.violation)
        return bool(np.abs(self._violated(self.wrapped.value(y).constraints)).max(initial=0.0) > far)

    def stiffen(self) -> bool:
        """Raise the penalty tenfold; return False if it has its largest value."""
        if self.penalty >= LARGEST_PENALTY:
            return False
        self.penalty = min(10.0 * self.penalty, LARGEST_PENALTY)
        return True

    def _forces(self, c: np.ndarray) -> np.ndarray:
        forces = self.multipliers + self.penalty * c
        return np.where(self.wrapped.search.equality, forces, np.maximum(forces, 0.0))

    def _violated(self, c: np.ndarray) -> np.ndarray:
        return np.where(self.wrapped.search.equality, c, np.maximum(c, 0.0))
