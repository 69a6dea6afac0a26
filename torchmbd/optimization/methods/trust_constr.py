"""SciPy's trust-constr (a trust-region interior point method).

The slowest of the methods with gradients, and the most robust one on ill-conditioned problems.
Source: scipy.optimize.minimize, method "trust-constr"; Byrd, Hribar and Nocedal, SIAM J. Optim. 9 (1999) 877-900.
"""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
from scipy.optimize import BFGS, Bounds, NonlinearConstraint, minimize

from torchmbd.optimization.methods.adapters import Stop, WrappedProblem, run_adapted
from torchmbd.optimization.optimizer import Ending, register, require_range
from torchmbd.optimization.search import Search

INSIDE = 1e-2  # distance of the start from the bounds, of the variable's size
BARRIER = 0.1


@register("trust-constr", dense=True)
def trust_constr(
    search: Search,
    max_iterations: int,
    *,
    gtol: float = 1e-10,
    xtol: float = 1e-8,
    initial_radius: float = 1.0,
    kkt: float = 1e-3,
) -> Ending:
    """Run trust-constr on one start.

    `gtol`, `xtol`: SciPy's. `initial_radius` of the trust region, in scaled variables. `kkt`: Kuhn-Tucker residual of an
    optimum.
    """
    for name, value in {"gtol": gtol, "xtol": xtol, "initial_radius": initial_radius, "kkt": kkt}.items():
        require_range(name, value, 1e-16, 1e3)
    options = {"gtol": gtol, "xtol": xtol, "initial_tr_radius": initial_radius}
    return run_adapted(search, partial(_run, options=options), max_iterations, kkt)


def _run(wrapped: WrappedProblem, options: dict[str, float]) -> Stop:
    # Its barrier needs a start inside the bounds; a later run begins nearer to them, with a lower barrier.
    distance = np.minimum(INSIDE * np.maximum(np.abs(wrapped.y), 1.0), 0.25 * (wrapped.upper - wrapped.lower))
    distance *= wrapped.shrink
    inside = np.clip(wrapped.y, wrapped.lower + distance, wrapped.upper - distance)

    def accepted(y: np.ndarray, state) -> bool:
        wrapped.record(np.array(y))
        return False

    constraints = [
        NonlinearConstraint(
            partial(wrapped.constraints, rows=rows),
            low,
            0.0,
            jac=partial(wrapped.jacobian, rows=rows),  # type: ignore[arg-type]
            hess=BFGS(),
        )
        for low, rows in ((0.0, wrapped.equal), (-np.inf, wrapped.unequal))
        if rows.size
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of quasi-Newton updates skipped along straight valleys
        result = minimize(
            wrapped.objective,
            inside,
            jac=wrapped.slope,
            hess=BFGS(),
            method="trust-constr",
            bounds=Bounds(wrapped.lower, wrapped.upper, keep_feasible=True),  # type: ignore[arg-type]
            constraints=constraints,
            callback=accepted,
            options={
                "maxiter": 10 * wrapped.remaining + 10,
                "initial_barrier_parameter": BARRIER * wrapped.shrink,
                "initial_barrier_tolerance": BARRIER * wrapped.shrink,
                **options,
            },
        )
    words = {1: "trust-constr's gradient criterion holds", 2: "trust-constr's steps are too small to go on"}
    # Its criteria are those of the barrier problem: only the Kuhn-Tucker residual counts as success.
    return Stop(result.x, False, words.get(int(result.status), f"trust-constr: {result.message}"))
