"""Table 3: the rod with the least integral of energy, from the paper's start designs. `python -m experiments.table3`

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
from experiments.slider_crank import DURATION, build

# laminate: start [deg], integral of 2U at start and optimum, reduction [%], optimum [deg], all as printed
PAPER = {
    1: ((45.0,), 0.0155818, 0.0012237, 92.2, "0"),
    2: ((45.0, -45.0), 0.011486, 0.001224, 89.3, "0/0"),
    3: ((45.0, -45.0, 45.0), 0.0135897, 0.0012520, 90.8, "0/-18.6/0"),
}


def problem(layers: int, angles: Sequence[float], steps: int = 600) -> mbd.Problem:
    """The optimization problem of one laminate."""
    energy = mbd.StrainEnergy("rod")
    return mbd.Problem(
        build(layers, angles),
        DURATION,
        minimize=mbd.Integral(energy),
        subject_to=[mbd.Max(energy) <= "initial"],
        bounds=mbd.deg([-90, 90]),
        steps=steps,
    )


def row(name: str, result: mbd.OptimizationResult, start: float) -> str:
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
    for layers, (start, initial, optimum, reduction, angles) in PAPER.items():
        printed = f"{initial / 2:.6f} -> {optimum / 2:.6f}  {reduction:5.1f}  %  {angles}"
        print(f"L{layers} {'paper / 2':19s} {printed}", flush=True)
        p = problem(layers, start)
        for method in arguments.methods.split(","):
            result = mbd.optimize(p, method=method)
            print(row(f"L{layers} {method}", result, result.history[0].objective), flush=True)
        if arguments.starts:
            study = mbd.multistart(p, method="mmfd", starts=mbd.sobol(arguments.starts, seed=7))
            best = study.best
            if best is not None:
                print(row(f"L{layers} best of {arguments.starts}", best, best.history[0].objective), flush=True)


if __name__ == "__main__":
    main()
