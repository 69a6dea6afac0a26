"""Work-precision of the integrators: what an error of the strain energy costs, method by method.

One design of the slider-crank, values alone, uncompiled, a tenth of the motion; the error is the largest difference of
the strain energy at the output times from a solution with tight tolerances, over its largest value.
"""

from __future__ import annotations

import time
from typing import Any

from torch import Tensor

import torchmbd as mbd
from experiments.benchmark.cases import Case, compilation, crank3
from experiments.benchmark.report import Cell, Grid, Result, Settings

OUTPUTS = 50
GIVEN_STEPS = {"generalized_alpha": (50, 100, 200, 400), "rk4": (150, 300), "heun3": (200, 400)}
TOLERANCES = {"dopri5": (1e-4, 1e-6), "dopri8": (1e-4, 1e-6), "bosh3": (1e-3, 1e-4)}


def energy(
    case: Case, duration: float, method: str, steps: int, **options: Any
) -> tuple[Tensor | None, float, int | None]:
    """Strain energy [OUTPUTS + 1] or None where the method failed, seconds, and evaluations of the right-hand side."""
    start = time.perf_counter()
    motion = mbd.simulate(case.system, duration, method=method, steps=steps, gradients="none", **options)
    seconds = time.perf_counter() - start
    U = motion.body("rod").strain_energy[0, :: steps // OUTPUTS]
    return U if motion.ok else None, seconds, motion.stats.get("evaluations")


def work_precision(settings: Settings) -> Result:
    """The table."""
    case = crank3(cells=(12, 2))
    duration = case.duration / (100 if settings.quick else 10)
    with compilation(False):
        exact, _, _ = energy(case, duration, "dopri8", OUTPUTS, rtol=1e-8, atol=1e-12)
        if exact is None:
            raise mbd.SimulationFailure("the solution that all methods are compared with failed")
        runs = [(method, f"{n} steps", n, {}) for method, counts in GIVEN_STEPS.items() for n in counts]
        runs += [
            (method, f"rtol {tol:g}", OUTPUTS, {"rtol": tol, "atol": 1e-2 * tol})
            for method, tolerances in TOLERANCES.items()
            for tol in tolerances
        ]
        rows: list[list[Cell]] = []
        for method, setting, steps, options in runs[::3] if settings.quick else runs:
            U, seconds, evaluations = energy(case, duration, method, steps, **options)
            error = None if U is None else float((U - exact).abs().max() / exact.max())
            rows.append([method, setting, error if error is not None else "failed", 1e3 * seconds, evaluations])
    columns = ["method", "setting", "error of U", "ms", "evaluations"]
    return Result(tables=[Grid(f"work-precision: slider-crank, {duration:g} s, one design, eager", columns, rows)])
