"""SciPy's differential evolution: no gradients, one batch per generation.

It needs finite bounds and many times the analyses of a method with gradients, and its result is as exact as its population is
narrow: gradients are asked for only where it is, to tell the Kuhn-Tucker residual. It serves to check the minima that a
multistart found. Constraints by Lampinen's rules (feasible before infeasible, then the smaller violation). A design that fails
is the worst of its generation. The extra variable of a min-max problem is not drawn: it is the largest row.

Source: Storn and Price, Differential evolution, J. Global Optimization 11 (1997) 341-359; Lampinen, A constraint handling
approach for the differential evolution algorithm, CEC 2002; scipy.optimize.differential_evolution.
Checked in tests/optimization/methods/test_evolution.py.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.optimize import NonlinearConstraint, differential_evolution

from torchmbd.errors import InputError
from torchmbd.optimization.optimizer import Ending, register, require_count, require_range
from torchmbd.optimization.search import Search

WORST = 1e9  # violation of a design that fails
NARROWER = 1e-2  # factor of the option tol where the best design of a narrow population is no Kuhn-Tucker point
ROUNDING = 1e-15  # of the objective: a population that narrow cannot become narrower


@register("differential_evolution", dense=True)
def evolution(
    search: Search, max_iterations: int, *, population: int = 15, tol: float = 1e-8, seed: int = 0, kkt: float = 1e-3
) -> Ending:
    """Run differential evolution; an iteration is a generation.

    `population`: designs per variable. `tol`: the population is narrow where the standard deviation of its objectives is
    this share of the largest one before; it must become narrower while its best design is beyond `kkt`, the Kuhn-Tucker
    residual of an optimum. That takes a gradient.
    """
    require_count("population", population, 2, 1000)
    for name, value in {"tol": tol, "kkt": kkt}.items():
        require_range(name, value, 0.0, 1.0)
    search.refuse_equalities("differential_evolution")
    drawn = search.size - search.has_extra_variable
    if not np.isfinite((search.upper - search.lower)[:drawn]).all():
        raise InputError(
            "bounds",
            allowed="finite, because method = 'differential_evolution' draws its designs from them",
            state="are infinite",
        )
    search.eager_gradients = False  # the method does not use them
    first = search.begin(gradients=False)
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    generation = _Generation(search, first.constraints.size, tol, kkt)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", (RuntimeWarning, UserWarning))  # of differences between infinite objectives
            differential_evolution(
                generation.objectives,
                list(zip(search.lower[:drawn], search.upper[:drawn], strict=True)),
                constraints=generation.rows(),
                x0=search.start[:drawn],
                maxiter=max_iterations,
                popsize=population,
                tol=0.0,  # SciPy's are relative to the mean, which a constant part changes
                atol=0.0,  # type: ignore[arg-type]
                rng=seed,
                polish=False,
                updating="deferred",
                vectorized=True,
                callback=generation.ended,
            )
    except RuntimeError as error:  # SciPy's, around an error of the problem
        raise error.__cause__ or error from None
    return _ending(search, generation.narrow, max_iterations)


class _Generation:
    """What SciPy calls: all designs of a generation at once, [n, k]."""

    def __init__(self, search: Search, constraints: int, tol: float, kkt: float) -> None:
        self.search, self.constraints, self.tol, self.kkt = search, constraints, tol, kkt
        self.spread = 0.0  # the largest standard deviation of the objectives of a generation
        self.narrow = False

    def designs(self, Y: np.ndarray) -> list[np.ndarray]:
        """Return designs, evaluated in one batch; of a min-max problem with their largest row as extra variable."""
        search = self.search
        designs = [np.append(y, search.start[y.size :]) for y in np.atleast_2d(Y.T)]
        search.prefetch(designs, gradients=False)
        for y in designs:
            search.evaluate(y)
        return [search.tightened(y) for y in designs]

    def objectives(self, Y: np.ndarray) -> np.ndarray:
        values = np.array([self.search.physical_objective(y) for y in self.designs(Y)])
        return np.where(np.isnan(values), np.inf, values)

    def violations(self, Y: np.ndarray) -> np.ndarray:
        worst = np.full(self.constraints, WORST)
        evaluations = [self.search.evaluate(y) for y in self.designs(Y)]
        return np.array([e.constraints if e.ok else worst for e in evaluations]).T

    def rows(self) -> tuple[NonlinearConstraint, ...]:
        return (NonlinearConstraint(self.violations, -np.inf, 0.0),) if self.constraints else ()

    def ended(self, intermediate_result) -> bool:
        """Record the best design of a generation where it is a new one; return whether the population is narrow."""
        energies = np.asarray(intermediate_result.population_energies)
        finite = energies[np.isfinite(energies)]
        spread = float(np.std(finite)) if finite.size else np.inf
        if finite.size and spread > self.spread:
            self.spread = spread
            self.search.set_objective_unit(spread)
        rounding = ROUNDING * float(np.abs(finite).max(initial=0.0))
        narrow = finite.size == energies.size and spread <= max(self.tol * self.spread, rounding)
        best = self.search.best
        if best is not None and not np.array_equal(self.search.physical(best), self.search.history[-1].x):
            self.search.record(best)
        if narrow and best is not None:
            self.narrow = spread <= rounding or not self.residual(best) > self.kkt
            self.tol *= NARROWER
        return self.narrow

    def residual(self, y: np.ndarray) -> float:
        """Return the Kuhn-Tucker residual of a design; nan where its gradient fails."""
        evaluation = self.search.evaluate(y, gradients=True)
        return self.search.kuhn_tucker(evaluation, y).residual if evaluation.ok else float("nan")


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
