"""The minima of the three-layer rod of Table 3: 64 starts beside a grid of all designs. `python -m experiments.paper.minima`

Every distinct minimum of 64 Sobol starts with the share of the starts that ended in it, the Bayesian estimate of how many
minima are left, and the best beside the best of a 5 degree grid refined locally. That one is stored in
minima_grid.json by `python -m experiments.paper.minima --grid`: all designs on a coarse model (mesh 8x2, 4 modes, 150
steps), then the grid's minima, one of each mirror pair, refined by MMFD on the model of the table. `--gradient-free` adds
differential evolution (coarse model) and says after how many simulations either has a design within a thousandth of the best.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import torchmbd as mbd
from experiments.paper.discrete import COARSE, problem_of
from experiments.paper.enumeration import enumerate_all
from experiments.paper.table3 import problem
from torchmbd.optimization import MultistartResult

START, INCREMENT, REFINED = (45.0, -45.0, 45.0), 5.0, 8
STORED = Path(__file__).parent / "minima_grid.json"


def angles(x: np.ndarray) -> str:
    """A design [rad] as text."""
    return "/".join(f"{a:z.1f}" for a in np.degrees(x))


def refine_grid(full: mbd.Problem) -> dict:
    """Enumerate on the coarse model, refine the best minima of the grid on the full one."""
    began = time.perf_counter()
    coarse = enumerate_all({"": problem(3, START, **COARSE)}, INCREMENT)[""]
    starts = coarse.X[coarse.minima(np.radians(INCREMENT))]
    study = mbd.optimization.multistart(full, "mmfd", list(starts[:REFINED]))
    return {
        "command": "python -m experiments.paper.minima --grid",
        "coarse": COARSE,
        "designs": coarse.size,
        "minima_of_the_grid": np.rint(np.degrees(starts)).tolist(),
        "refined": [{"angles": np.degrees(r.x).round(3).tolist(), "value": r.value} for r in study.results],
        "best": min(r.value for r in study.results if r.violation <= 1e-6),
        "seconds": round(time.perf_counter() - began),
    }


def print_study(study: MultistartResult, stored: dict | None) -> None:
    """Print the minima, the estimate of those left, and the comparison with the grid."""
    for k, minimum in enumerate(study.minima):
        print(f"minimum {k + 1}: {minimum.value:.7g} at {angles(minimum.x):20s} {minimum.count} starts")
    print(
        f"{study.converged} of {len(study.results)} starts converged in {study.analyses} analyses; estimated minima left: "
        f"{study.minima_left:.2f}, share of the space covered: {100 * study.covered:.0f} %"
    )
    if stored is not None and study.best is not None:
        print(f"best / best of the grid refined: {study.best.value / stored['best']:.6f} (at most 1.0001)")


def simulations_to(value: float, results: Sequence[mbd.optimization.OptimizationResult]) -> int | None:
    """Simulations after which searches in common batches have the first feasible design of `value` at most; None if never."""
    reached = [i.analyses for r in results for i in r.history if i.objective <= value and i.violation <= 1e-6]
    return sum(min(r.analyses, min(reached)) for r in results) if reached else None


def beside_evolution(coarse: mbd.Problem, starts: int, generations: int, population: int) -> list[str]:
    """Multistart with gradients beside differential evolution: ends, and simulations to the best of both within 0.1 %."""
    study = mbd.optimization.multistart(coarse, "mmfd", mbd.optimization.sobol(starts, seed=7))
    without = mbd.optimize(coarse, "differential_evolution", max_iterations=generations, population=population)
    assert study.best is not None
    target = 1.001 * min(study.best.value, without.value)
    counts = sorted(n for r in study.results if (n := simulations_to(target, [r])) is not None)
    sentence = (
        f"{len(counts)} of {starts} starts, each after {counts[0]} to {counts[-1]} of its own" if counts else "no start"
    )
    return [
        f"{starts} starts with gradients: {study.best.value:.7g} at {angles(study.best.x)} in {study.analyses} simulations; "
        f"within 0.1 % of the best after {simulations_to(target, study.results)} of all: {sentence}",
        f"differential evolution: {without.value:.7g} at {angles(without.x)} in {without.analyses} simulations; "
        f"within 0.1 % of the best after {simulations_to(target, [without])}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--starts", type=int, default=64)
    parser.add_argument("--grid", action="store_true", help="enumerate and refine the grid again, and store it")
    parser.add_argument(
        "--gradient-free", nargs="?", const="3", metavar="TABLE", help="differential evolution: 3, 4, 5, 3f"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    full = problem(3, START)
    if arguments.grid:
        stored = refine_grid(full)
        STORED.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
        print(
            f"best of {stored['designs']} designs refined: {stored['best']:.7g}, {stored['seconds']} s, in {STORED.name}"
        )
    elif arguments.gradient_free:
        coarse = problem_of(arguments.gradient_free, 3, **COARSE)
        print("\n".join(beside_evolution(coarse, starts=16, generations=150, population=8)))
    else:
        stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else None
        print_study(mbd.optimization.multistart(full, "mmfd", mbd.optimization.sobol(arguments.starts, seed=7)), stored)


if __name__ == "__main__":
    main()
