"""Ply angles in increments of 5 degrees, beside exhaustive enumeration. `python -m experiments.paper.discrete --enumerate`

The criteria of Tables 3, 4 and 5 over all designs whose angles are multiples of an increment, by torchmbd's discrete search:
relaxed minima of several starts, branches pruned with gradients, every candidate simulated, all neighbors within two
increments at the end. Beside it plain rounding of the best relaxed minimum and, with `--enumerate`, the best of all designs.

The optima of Tables 3 and 5 lie at zero, so that rounding finds them too. 3f is Table 3 with the peak of U free but the third
natural frequency of the rod, torsion, at least 1100 Hz (934 at zero degrees): its optima lie between the increments.

Coarse on purpose, so that enumeration is feasible: mesh 8x2 of triangles, 4 modes, 150 steps (chosen; the limit of 1100 Hz
is one for this mesh: with two quadrilaterals across torsion is 20 % lower). The 5 degree grid of four layers has
1.7 million designs; within 45 degrees (`--layers 4 --limit 45`) it has 130,321, and in steps of 10 degrees (`--increment 10`)
104,976. Simulations counted are those with gradients and those without alike.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from experiments.paper import table3, table4, table5
from experiments.paper.enumeration import Enumeration, enumerate_all
from torchmbd.examples.slider_crank import DURATION, build
from torchmbd.optimization import DiscreteResult, optimize_discrete

TORSION, LEAST = 3, 1100.0  # number of the natural frequency of torsion, and its limit [Hz]
COARSE: dict[str, Any] = {"cells": (8, 2), "modes": 4, "steps": 150, "kind": "triangle"}


def problem_of(table: str, layers: int, **options: Any) -> mbd.Problem:
    """The problem of a table, or 3f, from alternating 45 and -45 degrees; `options` of model and simulation."""
    start = [45.0 if i % 2 == 0 else -45.0 for i in range(layers)]
    if table == "3":
        return table3.problem(layers, start, **options)
    if table == "4":
        return table4.problem(layers, start, "direct", **options)
    if table == "5":
        return table5.problem(layers, start, "together", **options)
    return stiff_in_torsion(layers, **options)


def stiff_in_torsion(layers: int, steps: int, **options: Any) -> mbd.Problem:
    """The least integral of U with a lower limit of the frequency of torsion, from alternating 15 and -15 degrees."""
    start = [15.0 if i % 2 == 0 else -15.0 for i in range(layers)]
    return mbd.Problem(
        build(layers, start, **options),
        DURATION,
        minimize=mbd.Integral(mbd.StrainEnergy("rod")),
        subject_to=[mbd.Frequency("rod", TORSION) >= LEAST],
        bounds=mbd.deg([-90, 90]),
        steps=steps,
    )


class Within:
    """A problem whose angles stay within `limit` degrees."""

    def __init__(self, problem: mbd.Problem, limit: float):
        self.problem, self.names, self.start = problem, problem.names, problem.start
        self.lower, self.upper = (np.clip(b, *np.radians([-limit, limit])) for b in (problem.lower, problem.upper))
        self.period = problem.period
        self.evaluate = problem.evaluate


def lines(result: DiscreteResult, complete: Enumeration | None) -> list[str]:
    """What there is to say of one search."""
    best, rounded, certificate = result.best, result.rounded, result.certificate
    if best is None or rounded is None or certificate is None:
        return [f"{result.status}: {result.message}"]
    size = complete.size if complete else result.size
    said = [
        f"  discrete search  {best.value:.6g} at {_angles(best.x)}  {result.analyses} simulations, "
        f"{100 * result.analyses / size:.2f} % of {size:.0f}; {result.boxes} boxes; {result.status}",
        f"  plain rounding   {rounded.value:.6g} at {_angles(rounded.x)}  {100 * (rounded.value / best.value - 1):+.2f} %"
        f"{'' if rounded.violation <= 1e-6 else f', violates a constraint by {rounded.violation:.2g}'}",
        f"  certificate      {'holds' if certificate.holds else 'fails'}: {certificate.neighbors} neighbors, "
        f"{certificate.which}, the best of them {certificate.closest.value:.6g}"
        if certificate.closest
        else "",
    ]
    if complete is not None:
        value = complete.value.min()
        verdict = "equal" if abs(best.value / value - 1) <= 1e-9 else f"{complete.rank(best.value)} designs are better"
        said.append(f"  all designs      {value:.6g} at {_angles(complete.best)} and its mirror image  {verdict}")
    return said


def _angles(x: np.ndarray) -> str:
    return "/".join(f"{a + 0.0:.0f}" for a in np.rint(np.degrees(x)))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--layers", type=int, default=3)
    parser.add_argument("--increment", type=float, default=5.0, help="degrees, a part of 90")
    parser.add_argument("--limit", type=float, default=90.0, help="of the angles, degrees")
    parser.add_argument("--starts", type=int, default=8, help="of the relaxation, Sobol points")
    parser.add_argument("--enumerate", action="store_true", help="simulate every design as well (minutes)")
    parser.add_argument("--tables", default="3,5,3f", help="whose criteria to minimize: 3, 4, 5, 3f")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    problems = {
        f"Table {table}": problem_of(table, arguments.layers, **COARSE) for table in arguments.tables.split(",")
    }
    print(f"{arguments.layers} layers in steps of {arguments.increment:g} within {arguments.limit:g} degrees; {COARSE}")
    results = {}
    for name, problem in problems.items():
        began = time.perf_counter()
        starts = mbd.optimization.sobol(arguments.starts, seed=7, include_initial=True)
        within = Within(problem, arguments.limit)
        results[name] = optimize_discrete(within, float(np.radians(arguments.increment)), "mmfd", starts)
        if not arguments.enumerate:
            print(f"{name}: {time.perf_counter() - began:.0f} s", *lines(results[name], None), sep="\n", flush=True)
    if arguments.enumerate:
        began = time.perf_counter()
        complete = enumerate_all(problems, arguments.increment, arguments.limit)
        print(f"all designs in {time.perf_counter() - began:.0f} s")
        for name, result in results.items():
            print(f"{name}:", *lines(result, complete[name]), sep="\n", flush=True)


if __name__ == "__main__":
    main()
