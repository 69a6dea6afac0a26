"""Table 3: the rod with the least integral of energy, from the paper's start designs. `python -m experiments.paper.table3`

Minimize the integral of U over 0.06 s subject to the peak of U at most that of the start design (37), angles within
-90 and 90 degrees. Optimum, reduction, iterations and analyses beside the paper's; the paper prints 2U, so its integrals
are halved. `--starts 16` adds the best of that many Sobol starts for each laminate.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
import torch

import torchmbd as mbd
from torchmbd.examples.slider_crank import DURATION, LABELS, build

# laminate: start [deg], integral of 2U at start and optimum, reduction [%], optimum [deg], all as printed
PAPER = {
    1: ((45.0,), 0.0155818, 0.0012237, 92.2, "0"),
    2: ((45.0, -45.0), 0.011486, 0.001224, 89.3, "0/0"),
    3: ((45.0, -45.0, 45.0), 0.0135897, 0.0012520, 90.8, "0/-18.6/0"),
}


def problem(layers: int, angles: Sequence[float], steps: int = 600, **options) -> mbd.Problem:
    """The optimization problem of one laminate; `options` of the model, such as cells."""
    energy = mbd.StrainEnergy("rod")
    return mbd.Problem(
        build(layers, angles, **options),
        DURATION,
        minimize=mbd.Integral(energy),
        subject_to=[mbd.Max(energy) <= "initial"],
        bounds=mbd.deg([-90, 90]),
        steps=steps,
    )


def row(name: str, result: mbd.optimization.OptimizationResult, start: float) -> str:
    """One line of the table."""
    angles = "/".join(f"{a:.2f}" for a in np.degrees(result.x))
    counts = f"{result.iterations:4d} {result.analyses:5d}  violation {result.violation:.0e}  {result.status}"
    return f"{name:22s} {start:.6f} -> {result.value:.6f}  {100 * (1 - result.value / start):5.2f} %  {angles:22s} {counts}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--starts", type=int, default=0, help="also the best of so many Sobol starts")
    parser.add_argument("--methods", default="mmfd,slsqp")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("; ".join(f"{name}: {label}" for name, label in LABELS.items()))
    for layers, (start, initial, optimum, reduction, angles) in PAPER.items():
        printed = f"{initial / 2:.6f} -> {optimum / 2:.6f}  {reduction:5.1f}  %  {angles}"
        print(f"L{layers} {'paper / 2':19s} {printed}", flush=True)
        p = problem(layers, start)
        first = p.evaluate(p.start[None], gradients=False)[0].objective
        for method in arguments.methods.split(","):
            result = mbd.optimize(p, method=method)
            print(row(f"L{layers} {method}", result, first), flush=True)
        if arguments.starts:
            study = mbd.optimization.multistart(
                p, method="mmfd", starts=mbd.optimization.sobol(arguments.starts, seed=7)
            )
            if study.best is not None:
                print(row(f"L{layers} best of {arguments.starts}", study.best, first), flush=True)


if __name__ == "__main__":
    main()
