"""IPOPT (a primal-dual interior point method with a filter line search), by cyipopt where it is installed.

A design that fails is reported to IPOPT as such: it shortens the step. Second derivatives by its limited-memory BFGS.
Source: Waechter and Biegler, On the implementation of an interior-point filter line-search algorithm for large-scale nonlinear
programming, Math. Programming 106 (2006) 25-57; cyipopt.Problem.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from torchmbd.errors import not_installed
from torchmbd.optimization.methods.adapters import LimitReached, Stop, WrappedProblem, run_adapted
from torchmbd.optimization.optimizer import Ending, register, require_range
from torchmbd.optimization.search import Search

SENTENCES = {
    0: "IPOPT's criteria hold",
    1: "IPOPT's acceptable criteria hold",
    2: "IPOPT converged to a point of local infeasibility",
    3: "IPOPT's steps are too small to go on",
    -2: "IPOPT's restoration failed",
}
ITERATIONS_EXCEEDED = -1


@register("ipopt")
def ipopt(search: Search, max_iterations: int, *, tol: float = 1e-6, kkt: float = 1e-3) -> Ending:
    """Run IPOPT on one start. `tol`: IPOPT's; `kkt`: Kuhn-Tucker residual of an optimum."""
    try:
        cyipopt = import_module("cyipopt")
    except ImportError as error:
        remedy = "conda install -c conda-forge cyipopt"
        raise not_installed("method", "ipopt", "method = 'ipopt'", "cyipopt", remedy) from error
    for name, value in {"tol": tol, "kkt": kkt}.items():
        require_range(name, value, 1e-16, 1.0)
    return run_adapted(search, partial(_run, cyipopt=cyipopt, tol=tol), max_iterations, kkt)


def _run(wrapped: WrappedProblem, cyipopt, tol: float) -> Stop:
    calls = _Calls(wrapped, cyipopt.CyIpoptEvaluationError)
    equality = wrapped.search.equality
    problem = cyipopt.Problem(
        n=wrapped.y.size,
        m=equality.size,
        problem_obj=calls,
        lb=wrapped.lower,
        ub=wrapped.upper,
        cl=np.where(equality, 0.0, -np.inf),
        cu=np.zeros(equality.size),
    )
    calls.problem = problem
    options = {
        "print_level": 0,
        "sb": "yes",
        "hessian_approximation": "limited-memory",
        "tol": tol * wrapped.shrink,
        "constr_viol_tol": 0.5 * wrapped.search.feasibility,
        "max_iter": wrapped.remaining,
        "bound_push": 1e-2 * wrapped.shrink,  # a later run begins nearer to the bounds
        "mu_init": 0.1 * wrapped.shrink,
        "bound_relax_factor": 0.0,
    }
    for name, value in options.items():
        problem.add_option(name, value)
    y, info = problem.solve(wrapped.y)
    if calls.raised:
        raise calls.raised[0]
    code = int(info["status"])
    if code == ITERATIONS_EXCEEDED:
        raise LimitReached
    words = SENTENCES.get(code, f"IPOPT: {info['status_msg']!r}")
    return Stop(np.clip(y, wrapped.lower, wrapped.upper), code in (0, 1), words)


class _Calls:
    """What IPOPT calls. An exception of ours must not pass through it: the first is kept in `raised`, and the run stopped."""

    def __init__(self, wrapped: WrappedProblem, failed: type[Exception]) -> None:
        self.wrapped, self.failed = wrapped, failed
        self.rows = np.arange(wrapped.search.equality.size)
        self.problem: Any = None
        self.raised: list[BaseException] = []

    def objective(self, y: np.ndarray) -> float:
        return self._call(self.wrapped.objective, y)

    def gradient(self, y: np.ndarray) -> np.ndarray:
        return self._call(self.wrapped.slope, y)

    def constraints(self, y: np.ndarray) -> np.ndarray:
        return self._call(partial(self.wrapped.constraints, rows=self.rows), y)

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        return self._call(partial(self.wrapped.jacobian, rows=self.rows), y)

    def intermediate(self, *_) -> bool:
        """Record an accepted iterate; False stops the run."""
        if not self.raised and self.problem is not None:
            iterate = self.problem.get_current_iterate()
            if iterate is not None:
                self._call(self.wrapped.record, np.array(iterate["x"]), check=False)
        return not self.raised

    def _call(self, function: Callable[[np.ndarray], Any], y: np.ndarray, check: bool = True) -> Any:
        y = np.array(y)
        if self.raised:
            raise self.failed("stopped")
        try:
            failed = check and not self.wrapped.search.evaluate(y).ok
            result = None if failed else function(y)
        except BaseException as error:
            self.raised.append(error)
            failed, result = True, None
        if failed and check:
            raise self.failed("this design fails")
        return result
