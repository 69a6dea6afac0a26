"""Table 5: the rod with little energy and little torsion together. `python -m experiments.paper.table5`

Minimize the weighted sum (38), 0.6 of the integral of 2U and 0.4 of the integral of (u3_A - u3_B)^2 over 0.06 s, within
-90 and 90 degrees. Neither the nodes nor the normalization of the two criteria are printed. Here A and B are the corners
of the rod's end at the slider: their difference is the twist of that end (inferred), and

    together   2U in J, u3 in mm (`--unit`): the sum divided by its value at the start design (inferred: its local
               minimum near 45 degrees is as deep as the paper's)
    each       every criterion divided by its own value at the start design, which is poor for two layers: the start
               hardly twists

Both are one at the start, as in the table. `--sweep` prints both for one layer over its angle (Fig. 11) with their local
minima; `--starts 16` adds the best of that many Sobol starts.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
import torch

import torchmbd as mbd
from experiments.paper.table3 import row
from torchmbd.design import RelativeDisplacement, WeightedSum
from torchmbd.examples.slider_crank import DURATION, LABELS, build

# laminate: start [deg], optimum (1 at the start), reduction [%], optimum [deg], all as printed
PAPER = {
    1: ((45.0,), 0.978565, 2.14, "49.2"),
    2: ((45.0, -45.0), 0.145417, 85.45, "-10.53/13.37"),
    3: ((45.0, -45.0, 45.0), 0.632105, 36.789, "47.38/-18.25/47.38"),
}
WEIGHTS = (0.6, 0.4)
A, B = "corner_right_top", "corner_right_bottom"
CRITERIA = (
    mbd.Integral(2.0 * mbd.StrainEnergy("rod")),
    mbd.Integral(RelativeDisplacement("rod", A, B, "z") ** 2),
)


def objective(normalization: str, unit: float = 1e-3) -> WeightedSum:
    """The weighted sum, 1 at the start design."""
    if normalization == "each":
        return WeightedSum(list(zip(WEIGHTS, CRITERIA, strict=True)))
    both = WeightedSum(list(zip(WEIGHTS, CRITERIA, strict=True)), normalize=(1.0, unit**2))
    return WeightedSum([(1.0, both)])


def problem(
    layers: int, angles: Sequence[float], normalization: str = "each", unit: float = 1e-3, steps: int = 600, **options
) -> mbd.Problem:
    """The problem of one laminate; `options` of the model, such as cells."""
    return mbd.Problem(
        build(layers, angles, **options),
        DURATION,
        minimize=objective(normalization, unit),
        bounds=mbd.deg([-90, 90]),
        steps=steps,
    )


def sweep(problems: dict[str, mbd.Problem], degrees: np.ndarray) -> dict[str, np.ndarray]:
    """Objectives of one layer over its angle, Fig. 11."""
    X = np.radians(degrees)[:, None]
    return {name: np.array([e.objective for e in p.evaluate(X, gradients=False)]) for name, p in problems.items()}


def local_minima(degrees: np.ndarray, values: np.ndarray) -> str:
    """Angles and values at which a sampled curve is below both neighbors."""
    inner = np.flatnonzero((values[1:-1] < values[:-2]) & (values[1:-1] < values[2:])) + 1
    return ", ".join(f"{degrees[i]:g} deg ({values[i]:.4f})" for i in inner) or "none"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--starts", type=int, default=0, help="also the best of so many Sobol starts")
    parser.add_argument("--methods", default="mmfd,slsqp")
    parser.add_argument("--layers", default="1,2,3")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--unit", type=float, default=1e-3, help="unit of u3 [m] of the normalization 'together'")
    parser.add_argument("--normalizations", default="together,each")
    parser.add_argument("--sweep", action="store_true", help="objectives of one layer over its angle (Fig. 11)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("; ".join(f"{name}: {label}" for name, label in LABELS.items()), "; nodes A, B and normalization: inferred")
    names = arguments.normalizations.split(",")
    if arguments.sweep:
        degrees = np.arange(-90.0, 91.0, 1.0)
        problems = {name: problem(1, PAPER[1][0], name, arguments.unit, arguments.steps) for name in names}
        curves = sweep(problems, degrees)
        for i, angle in enumerate(degrees):
            print(f"{angle:6.1f}  " + "  ".join(f"{values[i]:8.4f}" for values in curves.values()))
        for name, values in curves.items():
            print(f"local minima, {name}: {local_minima(degrees, values)}", flush=True)
        return
    for layers in map(int, arguments.layers.split(",")):
        start, optimum, reduction, angles = PAPER[layers]
        print(f"L{layers} {'paper':23s} 1.000000 -> {optimum:.6f}  {reduction:5.2f} %  {angles}", flush=True)
        for name in names:
            p = problem(layers, start, name, arguments.unit, arguments.steps)
            for method in arguments.methods.split(","):
                print(row(f"L{layers} {name} {method}", mbd.optimize(p, method=method), 1.0), flush=True)
            if arguments.starts:
                study = mbd.optimization.multistart(
                    p, method="slsqp", starts=mbd.optimization.sobol(arguments.starts, seed=7)
                )
                if study.best is not None:
                    print(row(f"L{layers} {name} best of {arguments.starts}", study.best, 1.0), flush=True)


if __name__ == "__main__":
    main()
