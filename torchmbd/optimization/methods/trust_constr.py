"""SciPy's trust-constr (a trust-region interior point method) behind the door.

The slowest and the most patient of the family: a second opinion on ill-conditioned problems.
Source: scipy.optimize.minimize, method "trust-constr"; Byrd, Hribar and Nocedal, SIAM J. Optim. 9 (1999) 877-900.
"""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
from scipy.optimize import BFGS, Bounds, NonlinearConstraint, minimize

from torchmbd.optimization.methods.adapters import Guard, Stop, run_foreign
from torchmbd.optimization.optimizer import Ending, register, require_range
from torchmbd.optimization.search import Search

INSIDE = 1e-2
BARRIER = 0.1


@register("trust-constr")
def trust_constr(
    search: Search,
    max_iterations: int,
    *,
    gtol: float = 1e-10,
    xtol: float = 1e-8,
    initial_radius: float = 1.0,
    kkt: float = 1e-4,
) -> Ending:
    """Run trust-constr on one start. `gtol`, `xtol`: SciPy's; `initial_radius` of the trust region, in scaled variables."""
    for name, value in {"gtol": gtol, "xtol": xtol, "initial_radius": initial_radius, "kkt": kkt}.items():
        require_range(name, value, 1e-16, 1e3)
    options = {"gtol": gtol, "xtol": xtol, "initial_tr_radius": initial_radius}
    return run_foreign(search, partial(_run, options=options), max_iterations, kkt)


def _run(guard: Guard, options: dict[str, float]) -> Stop:
    # Its barrier needs a start inside the bounds; a later run begins nearer to them, with a lower barrier.
    room = np.minimum(INSIDE * np.maximum(np.abs(guard.y), 1.0), 0.25 * (guard.upper - guard.lower)) * guard.shrink
    inside = np.clip(guard.y, guard.lower + room, guard.upper - room)

    def accepted(y: np.ndarray, state) -> bool:
        guard.record(np.array(y))
        return False

    constraints = [
        NonlinearConstraint(
            partial(guard.constraints, rows=rows),
            low,
            0.0,
            jac=partial(guard.jacobian, rows=rows),  # type: ignore[arg-type]
            hess=BFGS(),
        )
        for low, rows in ((0.0, guard.equal), (-np.inf, guard.unequal))
        if rows.size
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of quasi-Newton updates skipped along straight valleys
        result = minimize(
            guard.objective,
            inside,
            jac=guard.slope,
            hess=BFGS(),
            method="trust-constr",
            bounds=Bounds(guard.lower, guard.upper, keep_feasible=True),  # type: ignore[arg-type]
            constraints=constraints,
            callback=accepted,
            options={
                "maxiter": 10 * guard.remaining + 10,
                "initial_barrier_parameter": BARRIER * guard.shrink,
                "initial_barrier_tolerance": BARRIER * guard.shrink,
                **options,
            },
        )
    words = {1: "trust-constr's gradient criterion holds", 2: "trust-constr's steps are too small to go on"}
    # Its criteria hold for the barrier problem, which is not ours: only the Kuhn-Tucker residual counts as success.
    return Stop(result.x, False, words.get(int(result.status), f"trust-constr: {result.message}"))
