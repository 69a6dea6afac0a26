"""SciPy's differential evolution: no gradients, one batch per generation.

It needs finite bounds and many times the analyses of a method with gradients, and its result is as exact as its population is
narrow: it serves to check the minima that a multistart found. Constraints by Lampinen's rules (feasible
before infeasible, then the smaller violation). A design that fails is the worst of its generation.

Source: Storn and Price, Differential evolution, J. Global Optimization 11 (1997) 341-359; Lampinen, A constraint handling
approach for the differential evolution algorithm, CEC 2002; scipy.optimize.differential_evolution.
Checked in tests/optimization/methods/test_evolution.py.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.optimize import NonlinearConstraint, differential_evolution

from torchmbd.errors import InputError
from torchmbd.optimization.optimizer import (
    Ending,
    Evaluation,
    register,
    require_count,
    require_range,
)
from torchmbd.optimization.search import Search

WORST = 1e9  # violation of a design that fails


@register("differential_evolution")
def evolution(
    search: Search, max_iterations: int, *, population: int = 15, tol: float = 1e-6, atol: float = 1e-8, seed: int = 0
) -> Ending:
    """Run differential evolution; an iteration is a generation.

    `population`: designs per variable. `tol`, `atol`: the end is where the standard deviation of the population's
    objectives is below atol (in units of the start's objective) + tol |mean|.
    """
    require_count("population", population, 2, 1000)
    for name, value in {"tol": tol, "atol": atol}.items():
        require_range(name, value, 0.0, 1.0)
    search.refuse_equalities("differential_evolution")
    if not np.isfinite(search.upper - search.lower).all():
        raise InputError("bounds are infinite: method = 'differential_evolution' draws its designs from finite bounds")
    search.eager_gradients = False  # the method does not use them
    first = search.begin(gradients=False)
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    generation = _Generation(search, first.constraints.size)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", (RuntimeWarning, UserWarning))  # of differences between infinite objectives
            result = differential_evolution(
                generation.objectives,
                list(zip(search.lower, search.upper, strict=True)),
                constraints=generation.rows(),
                x0=search.start,
                maxiter=max_iterations,
                popsize=population,
                tol=tol,
                atol=atol,  # type: ignore[arg-type]
                rng=seed,
                polish=False,
                updating="deferred",
                vectorized=True,
                callback=generation.ended,
            )
    except RuntimeError as error:  # SciPy's, around an error of the problem
        raise error.__cause__ or error from None
    return _ending(search, bool(result.success), max_iterations)


class _Generation:
    """What SciPy calls: all designs of a generation at once, [n, k]."""

    def __init__(self, search: Search, constraints: int) -> None:
        self.search, self.constraints = search, constraints

    def evaluations(self, Y: np.ndarray) -> list[Evaluation]:
        designs = list(np.atleast_2d(Y.T))
        self.search.prefetch(designs, gradients=False)
        return [self.search.evaluate(y) for y in designs]

    def objectives(self, Y: np.ndarray) -> np.ndarray:
        return np.array([e.objective if e.ok else np.inf for e in self.evaluations(Y)])

    def violations(self, Y: np.ndarray) -> np.ndarray:
        worst = np.full(self.constraints, WORST)
        return np.array([e.constraints if e.ok else worst for e in self.evaluations(Y)]).T

    def rows(self) -> tuple[NonlinearConstraint, ...]:
        return (NonlinearConstraint(self.violations, -np.inf, 0.0),) if self.constraints else ()

    def ended(self, intermediate_result) -> None:
        """Record the best design of a generation where it is a new one."""
        best = self.search.best
        if best is not None and not np.array_equal(self.search.physical(best), self.search.history[-1].x):
            self.search.record(best)


def _ending(search: Search, narrow: bool, max_iterations: int) -> Ending:
    best = search.best
    assert best is not None  # the start, if no other
    violation = search.violation(search.evaluate(best))
    if violation > search.feasibility:
        violated = search.violated(search.evaluate(best))
        return Ending(best, "infeasible", f"constraints {violated} remain violated by up to {violation:.3g}")
    if not narrow:
        return Ending(best, "max_iterations", f"the population is not narrow after {max_iterations} generations")
    return Ending(best, "converged", "the population has become narrow")
