"""SciPy's SLSQP (Kraft's sequential least squares programming).

Where constraints contradict each other it goes on for hundreds of evaluations. So a run ends where no design has been feasible
and the least violation has hardly fallen for some iterations; the search for the least infeasible design follows (api.py).
Source: scipy.optimize.minimize, method "SLSQP"; Kraft, A software package for sequential quadratic programming, DFVLR-FB
88-28 (1988).
"""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
from scipy.optimize import minimize

from torchmbd.optimization.methods.adapters import Stop, WrappedProblem, run_adapted
from torchmbd.optimization.optimizer import Ending, register, require_range
from torchmbd.optimization.search import Search

SENTENCES = {
    0: "SLSQP's criteria hold",
    4: "SLSQP found its linearized constraints contradictory",
    8: "SLSQP found no descent along its direction",
    9: "SLSQP reached the limit of iterations",
}
PATIENCE = 5  # iterations without a fall of the least violation
FALL = 0.1  # of the least violation


class ViolationRests(Exception):
    """No design has been feasible, and the violation no longer falls."""


@register("slsqp", dense=True)
def slsqp(search: Search, max_iterations: int, *, ftol: float = 1e-6, kkt: float = 1e-3) -> Ending:
    """Run SLSQP on one start. `ftol`: SciPy's; `kkt`: Kuhn-Tucker residual of an optimum."""
    require_range("ftol", ftol, 1e-16, 1.0)
    require_range("kkt", kkt, 1e-16, 1.0)
    # SLSQP measures constraints by the same tolerance.
    return run_adapted(search, partial(_run, ftol=min(ftol, search.feasibility)), max_iterations, kkt)


def _run(wrapped: WrappedProblem, ftol: float) -> Stop:
    def slope(y: np.ndarray) -> np.ndarray:
        df = wrapped.slope(y)
        wrapped.record(y)  # SciPy asks for gradients exactly where it accepted a step
        if _violation_rests(wrapped.search):
            raise ViolationRests
        return df

    def negative(function, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return -function(y, rows)

    constraints = [
        {
            "type": kind,
            "fun": partial(negative, wrapped.constraints),
            "jac": partial(negative, wrapped.jacobian),
            "args": (rows,),
        }
        for kind, rows in (("eq", wrapped.equal), ("ineq", wrapped.unequal))
        if rows.size
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            result = minimize(
                wrapped.objective,
                wrapped.y,
                jac=slope,
                method="SLSQP",
                bounds=list(zip(wrapped.lower, wrapped.upper, strict=True)),
                constraints=constraints,
                options={"maxiter": wrapped.remaining, "ftol": ftol * wrapped.shrink},
            )
        except ViolationRests:
            y = wrapped.y if wrapped.search.best is None else wrapped.search.best
            return Stop(y, False, f"SLSQP has not lowered the violation in {PATIENCE} iterations")
    return Stop(result.x, bool(result.success), SENTENCES.get(int(result.status), f"SLSQP: {result.message}"))


def _violation_rests(search: Search) -> bool:
    """True if no design of a search has been feasible, and the last PATIENCE ones have hardly lowered the violation.

    The start does not count: the first step meets the linearized constraints, and may raise the violation before it falls.
    """
    violations = [iterate.violation for iterate in search.history]
    if len(violations) <= PATIENCE + 1 or min(violations) <= search.feasibility:
        return False
    return min(violations[-PATIENCE:]) > (1.0 - FALL) * min(violations[1:-PATIENCE])
