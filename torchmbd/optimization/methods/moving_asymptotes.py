"""NLopt's MMA and CCSAQ (method of moving asymptotes, conservative convex separable approximations).

They accept only designs better than their conservative approximation promised; NLopt does not tell which, so an iterate here
is an evaluation that is better than all before it.
Source: Svanberg, A class of globally convergent optimization methods based on conservative convex separable approximations,
SIAM J. Optim. 12 (2002) 555-573; NLopt, algorithms LD_MMA and LD_CCSAQ.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module

import numpy as np

from torchmbd.errors import not_installed
from torchmbd.optimization.methods.adapters import LimitReached, Stop, WrappedProblem, run_adapted
from torchmbd.optimization.optimizer import Ending, register, require_range
from torchmbd.optimization.search import Search

EVALUATIONS_PER_ITERATION = 20  # a bound on NLopt's inner loop


@register("mma")
def mma(search: Search, max_iterations: int, *, ftol: float = 1e-7, xtol: float = 1e-7, kkt: float = 1e-3) -> Ending:
    """Run MMA on one start; `ftol`, `xtol`: NLopt's relative tolerances; `kkt`: Kuhn-Tucker residual of an optimum."""
    return _run_nlopt(search, max_iterations, "mma", "LD_MMA", ftol, xtol, kkt)


@register("ccsaq")
def ccsaq(search: Search, max_iterations: int, *, ftol: float = 1e-7, xtol: float = 1e-7, kkt: float = 1e-3) -> Ending:
    """Run CCSAQ on one start; `ftol`, `xtol`: NLopt's relative tolerances; `kkt`: Kuhn-Tucker residual of an optimum."""
    return _run_nlopt(search, max_iterations, "ccsaq", "LD_CCSAQ", ftol, xtol, kkt)


def _run_nlopt(
    search: Search, max_iterations: int, method: str, algorithm: str, ftol: float, xtol: float, kkt: float
) -> Ending:
    try:
        nlopt = import_module("nlopt")
    except ImportError as error:
        remedy = "pip install 'torchmbd[nlopt]'"
        raise not_installed("method", method, f"method = {method!r}", "nlopt", remedy) from error
    for name, value in {"ftol": ftol, "xtol": xtol, "kkt": kkt}.items():
        require_range(name, value, 1e-16, 1.0)
    search.refuse_equalities(method)
    return run_adapted(
        search, partial(_run, nlopt=nlopt, algorithm=algorithm, ftol=ftol, xtol=xtol), max_iterations, kkt
    )


def _run(wrapped: WrappedProblem, nlopt, algorithm: str, ftol: float, xtol: float) -> Stop:
    search = wrapped.search
    optimizer = nlopt.opt(getattr(nlopt, algorithm), wrapped.y.size)
    calls = _Calls(wrapped, optimizer)
    optimizer.set_lower_bounds(wrapped.lower)
    optimizer.set_upper_bounds(wrapped.upper)
    optimizer.set_min_objective(calls.objective)
    if wrapped.unequal.size:
        optimizer.add_inequality_mconstraint(calls.constraints, np.full(wrapped.unequal.size, 0.5 * search.feasibility))
    optimizer.set_ftol_rel(ftol * wrapped.shrink)
    optimizer.set_xtol_rel(xtol * wrapped.shrink)
    optimizer.set_maxeval(EVALUATIONS_PER_ITERATION * max(wrapped.remaining, 1))
    gave_up = ""
    try:
        y = optimizer.optimize(wrapped.y)
    except _errors(nlopt) as error:  # stopped by us, or a failure of its own, such as round-off
        reason = str(error) or type(error).__name__
        y, gave_up = wrapped.y if search.best is None else search.best, f"NLopt gave up: {reason}"
    if calls.raised:
        raise calls.raised[0]
    if gave_up:
        return Stop(y, False, gave_up)
    code = optimizer.last_optimize_result()
    if code == nlopt.MAXEVAL_REACHED:
        raise LimitReached
    return Stop(np.clip(y, wrapped.lower, wrapped.upper), code > 0, f"NLopt's criteria hold (code {code})")


def _errors(nlopt) -> tuple[type[Exception], ...]:
    """The errors of NLopt: from 2.11 on they are below `exception` of its own, before below RuntimeError and ValueError."""
    names = ("ForcedStop", "RoundoffLimited", "exception")
    return RuntimeError, ValueError, *(getattr(nlopt, name) for name in names if hasattr(nlopt, name))


class _Calls:
    """What NLopt calls. It does not pass on every exception, so the first is kept in `raised` and the run stopped."""

    def __init__(self, wrapped: WrappedProblem, optimizer) -> None:
        self.wrapped, self.optimizer = wrapped, optimizer
        self.raised: list[BaseException] = []

    def objective(self, y: np.ndarray, slope: np.ndarray) -> float:
        wrapped, search = self.wrapped, self.wrapped.search
        try:
            good = search.evaluate(y, gradients=slope.size > 0).ok
            if slope.size:
                slope[:] = wrapped.slope(y) if good else 0.0  # not used: a failed design is not accepted
            if good and search.best is not None and np.array_equal(search.best, y):
                wrapped.record(np.array(y))
            return wrapped.objective(y)
        except BaseException as error:
            return self._stop(error)

    def constraints(self, values: np.ndarray, y: np.ndarray, slopes: np.ndarray) -> None:
        wrapped = self.wrapped
        try:
            good = wrapped.search.evaluate(y, gradients=slopes.size > 0).ok
            values[:] = wrapped.constraints(y, wrapped.unequal)
            if slopes.size:
                slopes[:] = wrapped.jacobian(y, wrapped.unequal) if good else 0.0
        except BaseException as error:
            self._stop(error)

    def _stop(self, error: BaseException) -> float:
        self.raised.append(error)
        self.optimizer.force_stop()
        return 0.0
