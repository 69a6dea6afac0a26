"""`optimize`: check the arguments, run a method from one start, and return the result in physical units.

`run_start` runs one start, here and in `multistart`.
"""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from torchmbd.errors import InputError, argument_names, true_or_false, warnings_once
from torchmbd.optimization.failures import counted
from torchmbd.optimization.finer_motions import Begin, counted_from, search_with_finer_motions
from torchmbd.optimization.kkt import KuhnTucker
from torchmbd.optimization.least_infeasible import least_infeasible
from torchmbd.optimization.nearly_feasible import make_feasible, most_promising
from torchmbd.optimization.optimizer import (
    DEFAULT_METHOD,
    MOST_DENSE,
    Box,
    Ending,
    Iterate,
    Method,
    NonlinearProgram,
    OptimizationResult,
    as_numbers,
    checked_names,
    find_method,
    require_count,
    require_inside,
    require_method_of_size,
    require_problem,
    require_range,
)
from torchmbd.optimization.search import Interrupted, OutOfAnalyses, OutOfTime, Search, deadline_of
from torchmbd.optimization.units import variable_scale
from torchmbd.process import one_thread_of_blas
from torchmbd.progress import both, shown

MAX_ITERATIONS = 100
FEASIBILITY = 1e-6
KKT = 1e-3  # Kuhn-Tucker residual of an optimum, of methods without an option of this name


@warnings_once()
@one_thread_of_blas()
def optimize(
    problem: NonlinearProgram,
    method: str = DEFAULT_METHOD,
    start: np.ndarray | None = None,
    max_iterations: int = MAX_ITERATIONS,
    scaling: bool = True,
    callback: Callable[[Iterate], None] | None = None,
    *,
    feasibility: float = FEASIBILITY,
    eager_gradients: bool = True,
    max_analyses: int | None = None,
    max_time: float | None = None,
    progress: bool | None = None,
    **options: Any,
) -> OptimizationResult:
    """Minimize from one start.

    problem          such as a Problem; any object as described in optimizer.py
    method           "auto", "sqcqp", "slsqp", "mmfd", "lbfgs", "trust-constr", "mma", "ccsaq", "ipopt" or
                     "differential_evolution"
    start            initial design [n]; None: problem.start
    max_iterations   accepted designs at most
    scaling          measure variables by |start|, and the objective by its value and change there (units.py)
    callback         called with every accepted Iterate
    feasibility      largest violation of a constraint that still counts as feasible [-]
    eager_gradients  True: compute gradients together with every value, which saves one simulation per iteration; False:
                     compute them later, only where the method needs them
    max_analyses     simulations at most; None: any number
    max_time         limit of time [s]: no simulation begins after it, and the best design by then is the result, with the
                     status "max_time"; None: no limit
    progress         a bar of the iterations on standard error; None: in a terminal or a notebook
    options          the method's own

    The method steps back from a failed simulation; the result counts them. Raises InputError for an unknown method or
    option, crossed bounds, a start outside the bounds, wrong lengths.

    >>> energy = mbd.Integral(mbd.StrainEnergy("arm"))
    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-90, 90]))
    >>> result = mbd.optimize(problem, max_iterations=3)
    >>> bool(result.value < result.history[0].objective)
    True
    """
    function = find_method(method, options, argument_names(optimize))
    x, lower, upper = checked_box(problem, start)
    require_method_of_size(method, x.size)
    require_limits(max_iterations, max_analyses)
    require_range("feasibility", feasibility, 0.0, 1.0)
    scaling = true_or_false("scaling", scaling)
    eager_gradients = true_or_false("eager_gradients", eager_gradients)

    deadline = deadline_of(max_time)
    with shown(progress, method, max_iterations) as show:
        report = both(lambda iterate: show(iterate.iteration, iterate.objective), callback)

        def search(problem: NonlinearProgram, begins: Mapping[int, Begin]) -> dict[int, OptimizationResult]:
            [(start, iterations, parts)] = begins.values()
            settings: dict[str, Any] = {"feasibility": feasibility, "eager_gradients": eager_gradients}
            settings |= {"deadline": deadline}
            settings |= {"scale": variable_scale(start, lower, upper) if scaling else None}
            settings |= {"max_analyses": analyses_left(max_analyses, parts), "report": counted_from(parts, report)}
            search = Search.of(problem, problem.evaluate, start, lower, upper, **settings)
            return {0: run_start(search, function, method, iterations, options, problem)}

        return search_with_finer_motions(search, problem, {0: x}, max_iterations)[0]


def analyses_left(most: int | None, parts: Sequence[OptimizationResult]) -> int | None:
    """Return how many analyses a start may still have after some parts, at least 1; None: any number."""
    return None if most is None else max(1, most - sum(part.analyses for part in parts))


def require_limits(max_iterations: int, max_analyses: int | None) -> None:
    """Raise InputError unless both limits make sense."""
    require_count("max_iterations", max_iterations, 0, 1_000_000)
    if max_analyses is not None:
        require_count("max_analyses", max_analyses, 1, 1_000_000)


def checked_box(problem: Box, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return start, lower and upper [n] as float arrays; InputError names the variable that is wrong."""
    require_problem(problem)
    size = np.asarray(problem.start).size
    names = checked_names(problem, size)
    x = as_numbers("start", problem.start if start is None else start).reshape(-1)
    if x.size != size:
        raise InputError("start", allowed=f"must have {size} ({', '.join(names)})", state=f"has {x.size} entries")
    lower, upper = (
        np.array(np.broadcast_to(np.asarray(b, dtype=float), x.shape)) for b in (problem.lower, problem.upper)
    )
    for name, low, high in zip(names, lower, upper, strict=True):
        if not low <= high:
            raise InputError(
                ("lower", name),
                low,
                noun=f"bounds of {name}",
                allowed="must have lower <= upper",
                state=f"are crossed, with lower = {low:g} and upper = {high:g}",
            )
    require_inside("start", names, lower, x, upper)
    return x, lower, upper


def run_start(
    search: Search, function: Method, method: str, max_iterations: int, options: dict[str, Any], problem: Box
) -> OptimizationResult:
    """Run one method on one start and return its result; an interruption ends in the status of that name."""
    try:
        ending = function(search, max_iterations, **options)
        if ending.status == "infeasible":
            ending = restore_feasibility(search, ending, function, max_iterations, options)
        if ending.status not in ("converged", "failed") and make_feasible(search):
            status = "stalled" if ending.status == "infeasible" else ending.status
            ending = replace(ending, status=status, message=f"{ending.message}; a nearly feasible design was corrected")
        return build_result(search, ending, method, problem, kkt=tolerance_of(function, options))
    except (Interrupted, KeyboardInterrupt):
        status, message = "interrupted", "stopped by the user"
    except OutOfAnalyses:
        status, message = "max_iterations", f"the limit of {search.max_analyses} analyses was reached"
    except OutOfTime:
        status, message = "max_time", "the limit of time was reached"
    if not search.history and search.evaluate_known(search.start).ok:
        search.begin()  # the start was evaluated, in one batch with neighbors that were not
    best = search.start if search.best is None else search.best
    return build_result(search, Ending(best, status, message), method, problem, evaluate=False)


def tolerance_of(function: Method, options: dict[str, Any]) -> float:
    """Return the Kuhn-Tucker residual up to which a design counts as an optimum: the option `kkt` of the method."""
    known = inspect.signature(function).parameters.get("kkt")
    return float(options.get("kkt", KKT if known is None else known.default))


def restore_feasibility(
    search: Search, ending: Ending, function: Method, max_iterations: int, options: dict[str, Any]
) -> Ending:
    """Find the least infeasible design: run the method from there if it is feasible, else name the conflicting constraints.

    The search for it has matrices of n x n numbers, so it is left out, with a word, for many variables.
    """
    if search.size > MOST_DENSE:
        word = f"which constraints conflict is not known for more than {MOST_DENSE:,} variables"
        return replace(ending, message=f"{ending.message}; {word}")
    if make_feasible(search) and search.best is not None:
        y, violation, conflicting = search.best, 0.0, []
    else:
        least = least_infeasible(search, reported_design(search, ending)[0])
        y, violation, conflicting = least.y, least.violation, least.conflicting
    remaining = max_iterations - (len(search.history) - 1)
    if violation <= search.feasibility and remaining > 0:
        search.start = y
        return function(search, remaining, **options)
    if violation <= search.feasibility:
        return Ending(y, "max_iterations", f"{ending.message}; a feasible design was found")
    message = f"no design near here violates less than {violation:.3g}: constraints {conflicting} conflict with"
    return Ending(y, "infeasible", f"{message} each other or the bounds ({ending.message})")


def _is_flat(search: Search, y: np.ndarray) -> bool:
    """Return True if the gradient of the objective is zero at all designs near y that the search has seen."""
    gradients = [x.objective_gradient for _, x in search.nearest(y, search.size + 1)]
    return not any(df is not None and df.any() for df in gradients)


def build_result(
    search: Search, ending: Ending, method: str, problem: Box, evaluate: bool = True, kkt: float = KKT
) -> OptimizationResult:
    """Return the result in physical units, with multipliers.

    Whatever a method says, a design that is not feasible, or beyond the Kuhn-Tucker residual `kkt`, has not "converged".
    """
    y, status, message = reported_design(search, ending)
    evaluation = known = search.evaluate_known(y)
    value = search.physical_objective(y)
    if evaluate:
        with contextlib.suppress(OutOfAnalyses, OutOfTime):  # values are known, multipliers are not
            evaluation = search.evaluate(y, gradients=True)
    if known.ok and not evaluation.ok:
        evaluation, message = known, f"{message}; its gradient could not be evaluated: {evaluation.status}"
    violation = search.violation(evaluation) if evaluation.ok else float("nan")
    if status == "converged" and not violation <= search.feasibility:
        status, message = "infeasible", f"{message}, but a constraint is violated by {violation:.3g}"
    df = evaluation.objective_gradient
    if status == "converged" and len(search.history) == 1 and df is not None and not df.any() and _is_flat(search, y):
        message = "the objective does not depend on any variable near the start: its gradient is zero there and aside"
    feasible = next((i.iteration for i in search.history if i.violation <= search.feasibility), None)
    if feasible and violation <= search.feasibility:
        message += f"; the start violated a constraint by {search.history[0].violation:.3g}"
        message += f", designs are feasible since iteration {feasible}"
    m, n = evaluation.constraints.size, search.size
    quality = KuhnTucker(np.full(m, np.nan), np.full(n, np.nan), float("nan"))
    if evaluation.ok and evaluation.objective_gradient is not None:
        quality = search.kuhn_tucker(evaluation, y)
    if status == "converged" and not quality.residual <= kkt:
        status, message = (
            "stalled",
            f"{message}, but the Kuhn-Tucker residual {quality.residual:.2g} is beyond kkt = {kkt:g}",
        )
    elif status in ("stalled", "max_iterations") and violation <= search.feasibility and quality.residual <= kkt:
        status, message = "converged", f"the Kuhn-Tucker conditions hold ({message})"
    if status != "converged":
        message += better_elsewhere(search, getattr(problem, "sign", 1.0))
    return OptimizationResult(
        x=search.physical(y),
        value=value,
        constraints=evaluation.constraints,
        violation=violation,
        status=status,
        message=message,
        method=method,
        iterations=max(len(search.history) - 1, 0),
        analyses=search.analyses,
        gradient_evaluations=search.gradient_evaluations,
        failures=search.failures,
        reasons=counted(search.reasons.items()),
        feasibility=search.feasibility,
        history=search.history,
        multipliers=quality.multipliers * search.objective_scale,
        bound_multipliers=quality.bound_multipliers * search.objective_scale / search.scale,
        kkt_residual=quality.residual,
        names=list(problem.names),
        start=search.index,
        problem=problem,
    )


def better_elsewhere(search: Search, sign: float) -> str:
    """Return what a search knows of a better design that is nearly feasible; "" if it knows none.

    sign  from the value to the objective of the problem, -1 where that is maximized
    """
    candidate = most_promising(search)
    if candidate is None:
        return ""
    value = sign * search.physical_objective(candidate.y)
    return f"; a design of {value:.6g} violates a constraint by only {candidate.violation:.2g}. Try: more iterations"


def reported_design(search: Search, ending: Ending) -> tuple[np.ndarray, str, str]:
    """Return design, status and message: the method's design if it converged, else the best design evaluated."""
    best = search.best
    if best is None or ending.status == "converged":
        return search.tightened(ending.y), ending.status, ending.message
    return best, ending.status, ending.message
