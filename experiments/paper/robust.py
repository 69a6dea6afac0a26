"""Ply angles that bear a laying tolerance of 2.5 degrees, checked by sampling. `python -m experiments.paper.robust`

The two-layer rod of least integral of U whose frequency of torsion is at least 1100 Hz (3f of discrete.py). Three
designs: the nominal optimum, the least expected value and the least worst case over angles that are off by up to 2.5 degrees
each, by the gradients of the designs around it. For each the nominal value; mean (with its standard error), worst value and
worst violation of random angles within the tolerance, which no optimizer saw: 1024 inside, 256 on the edges of the box.

Coarse as in discrete.py (chosen).
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

import torchmbd as mbd
from experiments.paper.discrete import COARSE, problem_of


def sampled(
    problem: mbd.Problem, x: np.ndarray, d: float, count: int, seed: int = 0
) -> tuple[float, float, float, float]:
    """Mean, its standard error, worst value and worst violation of a design whose variables are off by up to d [rad]."""
    rng = np.random.default_rng(seed)
    inside = rng.uniform(-d, d, (count, x.size))
    edges = rng.uniform(-d, d, (count // 4, x.size))
    edges[np.arange(len(edges)), rng.integers(0, x.size, len(edges))] = d * rng.choice([-1.0, 1.0], len(edges))
    evaluations = problem.evaluate(x + np.vstack([inside, edges]), gradients=False)
    f = np.array([e.objective for e in evaluations])
    violation = max(float(e.constraints.max(initial=0.0)) for e in evaluations)
    return float(f[:count].mean()), float(f[:count].std() / np.sqrt(count)), float(f.max()), violation


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--tolerance", type=float, default=2.5, help="degrees")
    parser.add_argument("--samples", type=int, default=1024)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    problem, d = problem_of("3f", arguments.layers, **COARSE), float(np.radians(arguments.tolerance))
    nominal = mbd.optimization.multistart(problem, "mmfd", mbd.optimization.sobol(4, seed=7, include_initial=True)).best
    if nominal is None:
        raise SystemExit("no start ended feasible")
    designs = {"nominal optimum": (nominal.x, f"{nominal.value:.7f}")}
    for kind in ("expected", "worst"):
        robust = mbd.optimization.RobustProblem(problem, d, kind)
        start = np.append(nominal.x, 2.0)[: robust.start.size]
        if kind == "worst":
            corners = problem.evaluate(nominal.x + robust.shifts, False)
            start[-1] = robust.extra.of_largest(max(corner.objective for corner in corners))
        result = mbd.optimize(robust, "mmfd", start)
        designs[f"least {kind} value"] = robust.design(result.x), f"{result.value:.7f} ({result.status})"
    heads = ("angles [deg]", "nominal", "sampled mean", "worst", "violation", "criterion")
    print(f"{'':22s}{heads[0]:>16s}{heads[1]:>12s}{heads[2]:>24s}{heads[3]:>12s}{heads[4]:>11s}  {heads[5]}")
    for name, (x, criterion) in designs.items():
        value = problem.evaluate(x[None], False)[0].objective
        mean, error, worst, violation = sampled(problem, x, d, arguments.samples)
        angles = "/".join(f"{a:z.2f}" for a in np.degrees(x))
        mean_text = f"{mean:.7f} +- {error:.7f}"
        print(
            f"{name:22s}{angles:>16s}{value:12.7f}{mean_text:>24s}{worst:12.7f}{violation:11.1e}  {criterion}",
            flush=True,
        )


if __name__ == "__main__":
    main()
