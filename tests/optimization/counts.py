"""Function and gradient counts of our methods beside plain SciPy SLSQP's; `python -m tests.optimization.counts` prints it.

Counted are distinct designs: those with values, and those of them with gradients (asked for separately, not together).
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from tests.optimization import minimax
from tests.optimization.analytic import Analytic
from tests.optimization.hock_schittkowski import hock_schittkowski
from tests.optimization.structures import cantilever, three_bar_truss
from torchmbd.optimization import optimize
from torchmbd.optimization.units import variable_scale


@dataclass(frozen=True)
class Count:
    functions: int
    gradients: int
    error: float  # of the objective, relative to max(1, |optimum|), nearest known minimum
    violation: float
    status: str

    @property
    def solved(self) -> bool:
        return self.error <= 1e-4 and self.violation <= 1e-6


def problems() -> list[Analytic]:
    return [*hock_schittkowski(), three_bar_truss(), cantilever(), *minimax.problems()]


def error(problem: Analytic, value: float) -> float:
    """Return the distance of `value` to the nearest known minimum."""
    return min(abs(value - known) / max(1.0, abs(known)) for known in (problem.optimum, *problem.local))


def count(problem: Analytic, method: str, **options) -> Count:
    problem.reset()
    result = optimize(problem, method, max_iterations=200, eager_gradients=False, **options)
    return Count(problem.functions, problem.gradients, error(problem, result.value), result.violation, result.status)


def plain_slsqp(problem: Analytic) -> Count:
    """Count SciPy's SLSQP, its options untouched, on the same scaled problem, outside of optimize()."""
    problem.reset()
    scale = variable_scale(problem.start, problem.lower, problem.upper)

    def at(y, gradients=False):
        return problem.evaluate(np.clip(y * scale, problem.lower, problem.upper)[None], gradients)[0]

    first = at(problem.start / scale, gradients=True)
    unit = abs(first.objective) or 1.0
    rows = {
        "type": "ineq",
        "fun": lambda y: -at(y).constraints,
        "jac": lambda y: -at(y, True).constraint_gradients * scale,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = minimize(
            lambda y: at(y).objective / unit,
            problem.start / scale,
            jac=lambda y: at(y, True).objective_gradient * scale / unit,
            bounds=list(zip(problem.lower / scale, problem.upper / scale, strict=True)),
            constraints=[rows] if first.constraints.size else [],
            method="SLSQP",
            options={"maxiter": 200},
        )
    end = at(result.x)
    violation = max(0.0, end.constraints.max(initial=0.0))
    return Count(problem.functions, problem.gradients, error(problem, end.objective), violation, str(result.status))


def main(methods: list[str]) -> None:
    print("| problem | n, m | SLSQP f, g | " + " | ".join(f"{m} f, g | {m} error" for m in methods) + " |")
    print("|---|---|---|" + "---|---|" * len(methods))
    for problem in problems():
        plain = plain_slsqp(problem)
        m = problem.evaluate(problem.start[None], False)[0].constraints.size
        cells = [
            problem.name,
            f"{problem.start.size}, {m}",
            f"{plain.functions}, {plain.gradients}{'' if plain.solved else ' (not solved)'}",
        ]
        for method in methods:
            ours = count(problem, method)
            cells += [
                f"{ours.functions}, {ours.gradients}",
                f"{ours.error:.0e}{'' if ours.solved else ' (not solved)'}",
            ]
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main(sys.argv[1:] or ["mmfd"])
