"""SciPy's SLSQP (Kraft's sequential least squares programming) behind the door.

SciPy takes a run over not-a-number for success, so it never sees one: a failed evaluation is told as a wall, an
objective far above anything seen, from which its line search turns back. If it stops on the wall all the same, or
stops short of a Kuhn-Tucker point, it is started afresh from the best design, inside a box that leaves the wall
outside. Its tolerance is absolute: where the objective fell far below the start's, it is started afresh in units of
the objective reached.

Source: scipy.optimize.minimize, method "SLSQP"; Kraft, A software package for sequential quadratic programming,
DFVLR-FB 88-28.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from torchmbd.optimizers.kkt import kuhn_tucker
from torchmbd.optimizers.optimizer import Ending, Evaluation, register, require_range
from torchmbd.optimizers.search import Search
from torchmbd.optimizers.stationary import departure

RESTARTS = 3
SMALLEST_UNIT = 1e-9  # of the start's objective
WALL = 1e3  # times the last objective
FAR_BELOW = 0.05  # of the objective at the start of a run

SUCCESS = "SLSQP's criteria hold"
SENTENCES = {
    4: "SLSQP found its linearized constraints contradictory",
    8: "SLSQP found no descent along its direction",
    9: "SLSQP reached the limit of iterations",
}


class _OnTheWall(Exception):
    """SciPy wants a gradient where the evaluation failed."""


@register("slsqp")
def slsqp(search: Search, max_iterations: int, *, ftol: float = 1e-6, kkt: float = 1e-3) -> Ending:
    """Run SLSQP on one start. `ftol`: SciPy's; `kkt`: Kuhn-Tucker residual at which an early stop is good enough."""
    require_range("ftol", ftol, 1e-16, 1.0)
    require_range("kkt", kkt, 1e-16, 1.0)
    first = search.begin()
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    y = departure(search, first)[0]
    walls: list[np.ndarray] = []
    message = ""
    unit = 1.0
    for _ in range(1 + RESTARTS):
        remaining = max_iterations - (len(search.history) - 1)
        if remaining <= 0:
            break
        before, failures = y, search.failures
        result, message = _one_run(search, y, remaining, ftol, walls, unit)
        y = before if search.best is None else search.best
        if result is not None and search.evaluate(result.x).ok and _rank(search, result.x) <= _rank(search, y):
            y = result.x
        evaluation = search.evaluate(y, gradients=True)
        quality = kuhn_tucker(evaluation, y, search.lower, search.upper, search.equality)
        feasible = search.violation(evaluation) <= search.feasibility
        reached = abs(evaluation.objective)
        if feasible and result is not None and 0.0 < reached < FAR_BELOW * unit and quality.relative > kkt:
            unit = max(reached, SMALLEST_UNIT)
            continue
        # What looks like a minimum beside a wall, or on the border of a box around one, is none.
        success = result is not None and result.success and not walls and search.failures == failures
        if feasible and (success or quality.residual <= kkt):
            return Ending(y, "converged", SUCCESS if success else f"{message}: a Kuhn-Tucker point")
        if np.array_equal(before, y) and not walls:
            break
        message = SUCCESS if result is not None and result.success else message
    return _ending(search, y, message, max_iterations)


def _ending(search: Search, y: np.ndarray, message: str, max_iterations: int) -> Ending:
    if len(search.history) - 1 >= max_iterations:
        return Ending(y, "max_iterations", f"{max_iterations} iterations were not enough to converge")
    evaluation = search.evaluate(y)
    violation = search.violation(evaluation)
    if violation > search.feasibility:
        violated = search.violated(evaluation)
        return Ending(y, "infeasible", f"{message}: constraints {violated} remain violated by up to {violation:.3g}")
    return Ending(y, "stalled", f"the way down leads into designs that fail; {message}" if search.failures else message)


def _rank(search: Search, y: np.ndarray) -> tuple[bool, float]:
    evaluation = search.evaluate(y)
    violation = search.violation(evaluation)
    infeasible = violation > search.feasibility
    return infeasible, violation if infeasible else evaluation.objective


def _one_run(
    search: Search, y: np.ndarray, max_iterations: int, ftol: float, walls: list[np.ndarray], unit: float
) -> tuple[OptimizeResult | None, str]:
    """Run SciPy once from `y`, the objective in `unit`; a design on the wall is added to `walls` and ends the run."""
    last = [search.evaluate(y, gradients=True)]
    seen = {y.tobytes()}

    def value(x: np.ndarray) -> Evaluation:
        evaluation = search.evaluate(x)
        if evaluation.ok:
            last[0] = evaluation
            return evaluation
        return Evaluation(last[0].objective + WALL * max(1.0, abs(last[0].objective)), last[0].constraints)

    def gradient(x: np.ndarray) -> Evaluation:
        evaluation = search.evaluate(x, gradients=True)
        if not evaluation.ok:
            walls.append(x.copy())
            raise _OnTheWall(evaluation.status)
        if x.tobytes() not in seen:  # SciPy asks for gradients exactly where it accepted a step
            seen.add(x.tobytes())
            search.record(x)
        return evaluation

    lower, upper = _box(search, y, walls)
    constraints = [
        {
            "type": kind,
            "fun": lambda x, rows=rows: -value(x).constraints[rows],
            "jac": lambda x, rows=rows: -_rows(gradient(x), rows),
        }
        for kind, rows in (("eq", np.flatnonzero(search.equality)), ("ineq", np.flatnonzero(~search.equality)))
        if rows.size
    ]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            result = minimize(
                lambda x: value(x).objective / unit,
                y,
                jac=lambda x: _slope(gradient(x), unit),
                method="SLSQP",
                bounds=list(zip(lower, upper, strict=True)),
                constraints=constraints,
                options={"maxiter": max_iterations, "ftol": min(ftol, search.feasibility)},
            )
    except _OnTheWall as wall:
        return None, f"SLSQP stopped at a failed evaluation ({wall})"
    final = search.evaluate(result.x, gradients=True)
    if not final.ok:
        walls.append(result.x.copy())
        return None, f"SLSQP stopped at a failed evaluation ({final.status})"
    if result.x.tobytes() not in seen:
        search.record(result.x)
    return result, SENTENCES.get(int(result.status), f"SLSQP: {result.message}")


def _rows(evaluation: Evaluation, rows: np.ndarray) -> np.ndarray:
    assert evaluation.constraint_gradients is not None
    return evaluation.constraint_gradients[rows]


def _slope(evaluation: Evaluation, unit: float) -> np.ndarray:
    assert evaluation.objective_gradient is not None
    return evaluation.objective_gradient / unit


def _box(search: Search, y: np.ndarray, walls: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds that keep half the distance to every failed design."""
    radius = min((0.5 * float(np.abs(wall - y).max()) for wall in walls), default=np.inf)
    return np.maximum(search.lower, y - radius), np.minimum(search.upper, y + radius)
