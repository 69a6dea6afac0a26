"""Methods of optimization on ten problems whose optima are known: simulations until within CLOSE, starts that arrive, failures.

The problems are the ordinary parts of experiments/models/parts and two of the paper's slider-crank. All methods have the
same starts, the problem's own and one of a Sobol sequence, and at most ANALYSES simulations for each. A start arrives where a
feasible design is within CLOSE of the least value that any method has reached. Beside this value stands one that no search
has made: a closed form or a scan of the part (experiments/models/part_optima.py), the minimum of a grid of the slider-crank.

Checked in tests/experiments/test_benchmark_methods.py.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import torchmbd as mbd
from experiments.benchmark.report import Cell, Grid, Result, Settings
from experiments.models.part_optima import OPTIMA
from torchmbd.optimization.optimizer import OptimizationResult

CLOSE = 0.01  # of the optimum: the engineer's precision of a mass or an energy
STARTS, ANALYSES, SEED = 2, 40, 3
METHODS = ("auto", "slsqp", "mmfd", "mma", "trust-constr")
CONFIGS = Path(__file__).parents[2] / "configs" / "slider_crank"


@dataclass(frozen=True)
class Case:
    """A problem, and an optimum that no search has made; None: it is not known to 1 %."""

    problem: Callable[[], mbd.Problem]
    independent: Callable[[mbd.Problem], float | None]


def _part(name: str) -> Case:
    return Case(lambda: importlib.import_module(f"experiments.models.parts.{name}").problem(), OPTIMA[name])


def _slider_crank(name: str) -> Case:
    return Case(lambda: mbd.problem_of(CONFIGS / f"{name}.yaml"), _grid_minimum)


def _grid_minimum(problem: mbd.Problem) -> float:
    """The least objective of the feasible designs among those with all angles a multiple of 45 degrees."""
    angles = np.deg2rad([-90.0, -45.0, 0.0, 45.0])
    designs = np.stack(np.meshgrid(*[angles] * problem.start.size, indexing="ij"), -1).reshape(-1, problem.start.size)
    evaluations = problem.evaluate(designs, False)
    return min(e.objective for e in evaluations if e.ok and e.constraints.max(initial=-np.inf) <= 0.0)


CASES = {name: _part(name) for name in OPTIMA} | {
    "slider_crank_integral": _slider_crank("l3_energy_integral"),
    "slider_crank_peak": _slider_crank("l3_energy_peak"),
}


def arrival(result: OptimizationResult, optimum: float) -> int | None:
    """Return the simulations until a feasible design within CLOSE of the optimum; None: the search has none.

    The end of a search may be a corrected design that is not among its iterates.
    """
    limit = optimum + CLOSE * abs(optimum)
    designs = [(x.objective, x.violation, x.analyses) for x in result.history]
    designs.append((result.value, result.violation, result.analyses))
    return next((n for value, violation, n in designs if violation <= result.feasibility and value <= limit), None)


def least_value(results: Sequence[OptimizationResult]) -> float:
    """Return the least value of the feasible designs of several searches; nan: none is feasible."""
    return min((x.value for x in results if x.violation <= x.feasibility), default=math.nan)


def methods(settings: Settings) -> Result:
    """Run methods from the same starts; a start that does not arrive is counted, not left out."""
    names = settings.problems or (["turbine_blade"] if settings.quick else list(CASES))
    chosen = settings.methods or METHODS
    limit = 12 if settings.quick else ANALYSES
    grid: list[list[Cell]] = []
    figures: dict[str, Any] = {}
    for name in names:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of loads and steps, which are equal for all methods
            problem = CASES[name].problem()
            independent = CASES[name].independent(problem)
            starts = mbd.optimization.sobol(STARTS, seed=SEED, include_initial=True)
            results = {
                method: mbd.optimization.multistart(problem, method, starts, max_analyses=limit, progress=False).results
                for method in chosen
            }
        optimum = least_value([result for each in results.values() for result in each])
        for method, each in results.items():
            arrivals = [n for result in each if (n := arrival(result, optimum)) is not None]
            mean = sum(arrivals) / len(arrivals) if arrivals else None
            failures = sum(result.failures for result in each)
            figures[f"{name}: {method}"] = [mean, len(arrivals) / len(each), failures]
            converged = sum(result.converged for result in each)
            numbers = [abs(optimum), None if independent is None else abs(independent)]
            grid.append(
                [name, *numbers, method, mean, *(f"{n} of {len(each)}" for n in (len(arrivals), converged)), failures]
            )
    heads = ["problem", "optimum", "independent", "method", "simulations", "arrive", "converged", "failed"]
    title = f"simulations of a start until within {CLOSE:.0%} of the optimum, at most {limit}; starts that arrive"
    return Result(figures, [Grid(title, heads, grid), _summary(figures, chosen, len(names))])


def _summary(figures: dict[str, Any], chosen: Sequence[str], problems: int) -> Grid:
    """All problems together: starts that arrive, and simulations of those problems that every method solves from some start."""
    each = {method: [x for key, x in figures.items() if key.endswith(f": {method}")] for method in chosen}
    common = [k for k in range(problems) if all(each[method][k][0] is not None for method in chosen)]
    rows = [
        [
            method,
            f"{sum(x[1] for x in each[method]) / problems:.0%}",
            sum(each[method][k][0] for k in common) / len(common) if common else None,
            sum(x[2] for x in each[method]),
        ]
        for method in chosen
    ]
    title = f"all {problems} problems; simulations: the mean of the {len(common)} that every method solves"
    return Grid(title, ["method", "starts that arrive", "simulations", "failed"], rows)
