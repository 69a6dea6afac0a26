"""Energy against the frequency of torsion: the Pareto front of the rod. `python -m experiments.paper.pareto`

Stiff plies along the rod hold the energy down, plies at an angle raise the frequency of torsion; the two criteria of eq. (38)
do not fight each other: both are least at zero degrees. By the normalized normal constraint method. Prints the points with
their exchange rate (the weights of the sum that they minimize, each criterion in units of its range), draws the front over
all designs in steps of 5 degrees, and says by how much any of these is better than a point of the front in both criteria.
Two layers, coarse as in discrete.py (chosen).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

import torchmbd as mbd
from experiments.paper.discrete import COARSE, TORSION
from experiments.paper.enumeration import grid
from torchmbd.examples.slider_crank import DURATION, build
from torchmbd.optimization import Front

INCREMENT, LANES = 5.0, 512  # of the designs behind the front [deg], and of a batch


def tradeoff(layers: int, steps: int, **options: Any) -> mbd.Tradeoff:
    """Both criteria of the rod [mJ s], [Hz], the frequency with a minus; `options` of the model."""
    criteria = {
        "energy": 1e3 * mbd.Integral(mbd.StrainEnergy("rod")),
        "torsion": -1.0 * mbd.Frequency("rod", TORSION),
    }
    return mbd.Tradeoff(build(layers, **options), DURATION, criteria, bounds=mbd.deg([-90, 90]), steps=steps)


def drawn(front: Front, others: np.ndarray) -> Figure:
    """The front, and the criteria [designs, 2] of other designs behind it."""
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.scatter(others[:, 0], -others[:, 1], s=9, color="#c0c0c0", label="all designs in steps of 5 degrees")
    axes.plot(
        front.criteria[:, 0], -front.criteria[:, 1], color="#0072b2", marker="o", ms=4, lw=1.2, label="Pareto front"
    )
    axes.set_xlabel("integral of U [mJ s]")
    axes.set_ylabel("third natural frequency [Hz]")
    axes.set_xscale("log")
    axes.legend(frameon=False)
    axes.grid(color="#e8e8e8", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def beaten(front: Front, others: np.ndarray) -> float:
    """By how much one of `others` [designs, 2] betters a point of the front in both criteria, as a share of their ranges."""
    gains = (front.criteria[:, None] - others) / (front.nadir - front.utopia)
    return float(gains.min(axis=-1).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--divisions", type=int, default=8)
    parser.add_argument("--folder", type=Path, default=Path.cwd(), help="where the picture goes")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    problem = tradeoff(arguments.layers, **COARSE)
    starts = mbd.optimization.sobol(8, seed=7, include_initial=True)
    front = mbd.optimization.pareto_front(problem, arguments.divisions, "mmfd", starts=starts, everywhere=True)
    print(
        f"{len(front.points)} points, {front.dropped} dropped, {front.failed} not found; {front.analyses} simulations"
    )
    print("energy [mJ s]  torsion [Hz]  weights      angles [deg]")
    for point in front.points:
        weights = "/".join(f"{w:.2f}" for w in point.weights)
        angles = "/".join(f"{a:z.2f}" for a in np.degrees(point.x))
        print(f"{point.criteria[0]:13.6f}  {-point.criteria[1]:12.1f}  {weights:11s}  {angles}")
    X, count = grid(arguments.layers, INCREMENT)
    parts = (problem.evaluate(X[k : k + LANES], False) for k in range(0, len(X), LANES))
    others = np.array([criteria.values for part in parts for criteria in part if criteria.ok])
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for ending in (".png", ".pdf"):
        mbd.viz.save(drawn(front, others), arguments.folder / f"pareto{ending}")
    print(
        f"of {count} designs the one that betters a point of the front most is {beaten(front, others):+.4f} of the ranges away"
    )


if __name__ == "__main__":
    main()
