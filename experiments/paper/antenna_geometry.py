"""How far the antenna's stand-in geometry matters: the reduction of eq. (40) with one thing changed at a time.

`torchmbd run configs/sar_antenna/geometry.yaml`, which lists what is changed: options of experiments.models.sar_antenna.build.
Both designs, the start of Table 7 and `OPTIMUM`, are simulated for each case; the design is not optimized anew.
Checked in tests/experiments/test_sar_antenna_optimum.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

import torchmbd as mbd
from experiments.models.sar_antenna import build
from experiments.models.sar_antenna_data import ANGLES, INTEGRATOR
from experiments.paper.antenna_optimum import MODEL, OPTIMUM, START
from experiments.paper.antenna_tables import OBJECTIVE


def figures(
    folder: Path, cases: Mapping[str, Mapping[str, Any]], steps: int = 300, duration: float = 3.0
) -> dict[str, float | str]:
    """Reductions [%] and integrals [J s] of all cases, and their picture.

    cases   name -> what is changed, options of experiments.models.sar_antenna.build
    """
    numbers: dict[str, float | str] = {}
    reductions = {}
    for name, options in cases.items():
        first, last = integrals(steps, duration, **options)
        reductions[name] = 100.0 * (1.0 - last / first)
        numbers |= {f"{name}/initial": first, f"{name}/optimum": last, f"{name}/reduction_percent": reductions[name]}
        print(f"{name:32s} {first:.5f} -> {last:.6f} J s, reduction {reductions[name]:.1f} %", flush=True)
    mbd.viz.save(bars(reductions), folder / "geometry.png")
    low, high = min(reductions.values()), max(reductions.values())
    return numbers | {"sentence": f"reductions of {len(cases)} geometries: {low:.1f} to {high:.1f} % (paper: 95.6)"}


def integrals(steps: int, duration: float, **options: Any) -> tuple[float, float]:
    """Eq. (40) of the start of Table 7 and of `OPTIMUM` [J s]."""
    designs = {ANGLES: torch.stack([mbd.deg(list(x)) for x in (START, OPTIMUM)])}
    system = build(START, **(MODEL | options))
    settings: dict[str, Any] = {"steps": steps, "halvings": 0, "gradients": "none"} | INTEGRATOR[
        options.get("trusses", "rigid")
    ]
    first, last = OBJECTIVE.value(mbd.simulate(system, duration, designs=designs, **settings).require_ok()).tolist()
    return first, last


def bars(reductions: Mapping[str, float]) -> Figure:
    """The reductions [%] one below the other."""
    figure = Figure(figsize=(6.0, 0.6 + 0.28 * len(reductions)), layout="constrained")
    axes = figure.subplots()
    axes.barh(list(reductions)[::-1], list(reductions.values())[::-1], color="#0072b2")
    axes.set_xlim(min(90.0, *reductions.values()), 100.0)
    axes.set_xlabel("reduction of eq. (40) [%]")
    axes.axvline(95.6, color="#444444", lw=1.0, ls="--")
    return figure
