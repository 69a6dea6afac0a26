"""How the criteria depend on the angles, and the optima over time: Figs. 8-11. `python -m experiments.paper.figures8_11`

To MLflow: `torchmbd run configs/slider_crank/figures8_11.yaml`.

Fig. 8    one layer: integral and peak of U over the angle, divided by those of the start design, 45 degrees
Fig. 9    three layers: U over time of the start design, of the least integral (Table 3) and of the least peak (Table 4)
Fig. 10   one layer: energy and twist of the weighted sum (Table 5) over the iterations of MMFD
Fig. 11   one layer: the weighted sum over the angle, normalized as in table5.py (inferred)

In the paper Fig. 8 has one minimum, and Fig. 11 a local one near 45 degrees in which its optimization of one layer ended.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

import torchmbd as mbd
from experiments.paper import table3, table4, table5
from experiments.paper.figures4_7 import COLORS, save
from experiments.paper.table5 import local_minima

ENERGY = mbd.StrainEnergy("rod")


def over_the_angle(folder: Path, increment: float, **options: Any) -> dict[str, float | str]:
    """Figs. 8 and 11 from one batch of designs; the numbers are the minima that they have."""
    degrees = np.arange(-90.0, 90.0 + increment / 2, increment)
    weighted = table5.problem(1, (45.0,), "together", **options)
    motion = weighted.simulate(np.radians(np.append(45.0, degrees))[:, None]).require_ok()
    values = {
        "integral of U": mbd.Integral(ENERGY).value(motion).numpy(),
        "peak of U": mbd.Max(ENERGY).value(motion).numpy(),
        "weighted sum": weighted.reference.measures[0].value(motion).numpy(),
    }
    ratios = {name: y[1:] / y[0] for name, y in values.items()}
    total = {"weighted sum": ratios.pop("weighted sum")}
    save(mbd.viz.criterion(degrees, ratios, "angle 1 [deg]", mark=45.0), folder / "figure8")
    save(mbd.viz.criterion(degrees, total, "angle 1 [deg]", mark=45.0), folder / "figure11")
    return {
        "figure8_minima": local_minima(degrees, ratios["integral of U"]),
        "figure11_minima": local_minima(degrees, total["weighted sum"]),
    }


def over_time(folder: Path, max_iterations: int, **options: Any) -> dict[str, float]:
    """Fig. 9; the numbers are the peaks of its curves."""
    start = (45.0, -45.0, 45.0)
    integral, peak = table3.problem(3, start, **options), table4.problem(3, start, "direct", **options)
    least = [mbd.optimize(p, "mmfd", max_iterations=max_iterations).x for p in (integral, peak)]
    motion = integral.simulate(np.array([integral.start, *least])).require_ok()
    names = ("start design", "least integral", "least peak")
    U = motion.body("rod").strain_energy.numpy()
    save(mbd.viz.energy_over_time(motion.t.numpy(), dict(zip(names, U, strict=True))), folder / "figure9")
    return {f"figure9_peak_{name.replace(' ', '_')}": float(u.max()) for name, u in zip(names, U, strict=True)}


def over_iterations(folder: Path, max_iterations: int, **options: Any) -> dict[str, float]:
    """Fig. 10; the numbers are both criteria at the end, divided by their values at the start."""
    problem = table5.problem(1, (45.0,), "together", **options)
    history = mbd.optimize(problem, "mmfd", max_iterations=max_iterations).history
    motion = problem.simulate(np.array([iterate.x for iterate in history])).require_ok()
    names = ("integral of 2U", "integral of the twist squared")
    values = {name: x.value(motion).numpy() for name, x in zip(names, table5.CRITERIA, strict=True)}
    ratios = {name: y / y[0] for name, y in values.items()}
    save(iterations(ratios), folder / "figure10")
    return {f"figure10_{name.replace(' ', '_')}": float(y[-1]) for name, y in ratios.items()}


def iterations(lines: Mapping[str, np.ndarray]) -> Figure:
    """Criteria over the iterations."""
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.subplots()
    for (label, y), color in zip(lines.items(), COLORS[1:], strict=False):
        axes.plot(range(len(y)), y, color=color, lw=1.3, marker="o", ms=3, label=label)
    axes.set_xlabel("iteration")
    axes.set_ylabel("criterion / criterion at start")
    axes.locator_params(axis="x", integer=True)
    axes.legend(frameon=False)
    axes.grid(color="#e8e8e8", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def figures(
    folder: Path,
    cells: Sequence[int] = (24, 4),
    modes: int = 8,
    steps: int = 600,
    increment: float = 2.5,
    max_iterations: int = 30,
) -> dict[str, float | str]:
    """All four figures into the folder; returns the numbers that they show, and what they say in a sentence."""
    options: dict[str, Any] = {"cells": tuple(cells), "modes": modes, "steps": steps}
    numbers: dict[str, float | str] = {**over_the_angle(folder, increment, **options)}
    numbers |= over_time(folder, max_iterations, **options)
    numbers |= over_iterations(folder, max_iterations, **options)
    sentence = (
        f"Minima over the angle of one layer: integral of U {numbers['figure8_minima']}; weighted sum "
        f"{numbers['figure11_minima']}. Peak of U of three layers: {numbers['figure9_peak_start_design']:.4f} J at the start, "
        f"{numbers['figure9_peak_least_integral']:.4f} J with the least integral, "
        f"{numbers['figure9_peak_least_peak']:.4f} J with the least peak."
    )
    return {**numbers, "sentence": sentence}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path.cwd(), help="where the figures go")
    parser.add_argument("--steps", type=int, default=600, help="time steps")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    numbers = figures(arguments.folder, steps=arguments.steps)
    for name, value in numbers.items():
        print(f"{name}: {value if isinstance(value, str) else f'{value:.6g}'}")


if __name__ == "__main__":
    main()
