"""Parts of section 6, the SAR antenna: Tables 6-8, Figs. 15-26.

Counts, panels, material, lay-ups and the actuator are given; places of the joints and trusses are *chosen*, and two of them
were picked after seeing the two integrals of Table 8 (experiments/models/sar_antenna_data.py).
Checked in tests/experiments/test_paper.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from experiments.models.sar_antenna import build, phi3, theta
from experiments.models.sar_antenna_clearance import gaps, verdict
from experiments.models.sar_antenna_data import ANGLES
from experiments.models.sar_antenna_whole import unlocked
from experiments.paper import antenna_optimum
from experiments.paper.antenna_optimum import MODEL, START
from experiments.paper.antenna_tables import ENERGY, LAYUPS, PAPER, REFERENCE_TIMES, reaches_zero, shares
from experiments.paper.part import Part, Row
from experiments.paper.rod import angles
from torchmbd.viz.figures import CYCLE, figure_of, over_time

OPTIMUM = (1.06, -47.0)  # Table 8 [deg]


def curves(t: Any, lines: Mapping[str, Any], ylabel: str, path: Path) -> None:
    """Draw histories over time."""
    figure, (axes,) = figure_of(3.4)
    for (label, y), color in zip(lines.items(), CYCLE, strict=False):
        over_time(axes, t, y, label, color)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(ylabel)
    axes.legend(frameon=False)
    mbd.viz.save(figure, path)


def layups(folder: Path, rate: int, modes: int) -> list[Row]:
    """Table 6, Figs. 15-18: the two lay-ups, modes, failure, actuator angle."""
    description = unlocked().describe()
    kinds = [joint.kind for joint in description.joints]
    rows = [
        Row("Fig. 15: bodies", 12, len(description.bodies) + 1, "given"),
        Row("Fig. 15: spherical joints", 16, kinds.count("Spherical"), "given"),
        Row("Fig. 15: revolute joints", 3, kinds.count("Revolute"), "given"),
        Row("Table 6: lay-up 1 (deg)", "0/0/0/0", stack("lay-up 1"), "given"),
        Row("Table 6: lay-up 2 (deg)", "0/90/90/0", stack("lay-up 2"), "given"),
    ]
    draw_modes(build(LAYUPS["lay-up 2"], modes=modes), folder / "figure16.png")
    lines = {}
    for name in ("lay-up 1", "lay-up 2"):
        motion = mbd.simulate(build(LAYUPS[name], modes=modes), 9.0, steps=9 * rate, halvings=0, gradients="none")
        lines[name] = theta(motion)[0]
        when = reaches_zero(motion)
        rows.append(
            Row(f"Fig. 18: theta = 0, {name} (s)", "7 to 8", when, "chosen", f"reference {REFERENCE_TIMES[name]} s")
        )
    curves(motion.t, lines, "angle of the actuator [rad]", folder / "figure18.png")
    fair, arms = (
        mbd.simulate(build((0.0, 0.0), modes=modes, arm=arm), 3.0, steps=3 * rate, gradients="none")
        for arm in (0.0, 0.05)
    )
    both = {"trusses": theta(arms)[0], "panel 3": phi3(arms)[0], "panel 3, joints in the mid-surface": phi3(fair)[0]}
    curves(arms.t, both, "angle from panel 2 [rad]", folder / "figure17.png")
    note = "joints 50 mm off the mid-surfaces"
    rows.append(Row("Fig. 17: with forces that bend the panels", "panel 3 hardly moves", verdict(arms), "chosen", note))
    return rows


def stack(name: str) -> str:
    """A lay-up of four layers as the paper prints it."""
    layers = LAYUPS[name]
    if layers is None:
        raise mbd.InputError("name", name, "a design with a laminate")
    return angles([*layers, *layers[::-1]])


def draw_modes(system: mbd.System, path: Path) -> None:
    """Draw the first six modes of vibration of panel 2, deflection across its plane."""
    from matplotlib.figure import Figure

    body: Any = system.body("panel2")
    motion = mbd.simulate(system, 1e-4, steps=1, gradients="none")
    x, y = body.mesh.nodes[:, 0].numpy(), body.mesh.nodes[:, 1].numpy()
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    frequencies = torch.linalg.eigvalsh(motion.body("panel2").stiffness[0][0]).sqrt() / (2.0 * np.pi)
    for k, axes in enumerate(figure.subplots(2, 3).flat):
        w = motion.modes("panel2")[0, :, 2, k].numpy()
        axes.tripcolor(x, y, w, cmap="RdBu_r", vmin=-abs(w).max(), vmax=abs(w).max(), shading="gouraud")
        axes.set_title(f"{float(frequencies[k]):.2f} Hz", fontsize=9)
        axes.set_aspect("equal")
        axes.set_axis_off()
    mbd.viz.save(figure, path)


def optimum(folder: Path, steps: int, max_iterations: int = 40, **model: Any) -> list[Row]:
    """Tables 7, 8, Figs. 20-23: the optimization, and both designs over the time."""
    problem = antenna_optimum.problem(steps, **model)
    result = mbd.optimize(problem, method="mmfd", max_iterations=max_iterations)
    first, x = result.history[0].objective, np.degrees(result.x)
    iterations = [iterate.objective for iterate in result.history]
    mbd.viz.save(mbd.viz.convergence({"MMFD": iterations}, {"MMFD": [iterate.violation for iterate in result.history]}),
                 folder / "figure20.png")  # fmt: skip
    design = np.degrees([iterate.x for iterate in result.history])
    lines = {"theta 1": design[:, 0], "theta 2": design[:, 1]}
    curves(np.arange(len(design)), lines, "angle [deg], over iterations", folder / "figure21.png")
    motion = problem.simulate(np.array([problem.start, result.x, np.radians(OPTIMUM)])).require_ok()
    names = ("initial", "optimum", "the paper's optimum")
    for number, panel in ((22, "panel2"), (23, "panel3")):
        U = motion.body(panel).strain_energy
        curves(motion.t, dict(zip(names, U, strict=True)), f"energy of {panel} [J]", folder / f"figure{number}.png")
    printed = mbd.Integral(ENERGY["panel2"] + ENERGY["panel3"]).value(motion)
    U = {panel: motion.body(panel).strain_energy.mean(1) for panel in ENERGY}
    saved = (U["panel2"][0] - U["panel2"][1]) / (U["panel2"][0] + U["panel3"][0] - U["panel2"][1] - U["panel3"][1])
    return [
        Row("Table 7: start (deg)", "55/-55", angles(np.degrees(problem.start)), "given"),
        Row(
            "Table 8: eq. (40) at the start (J s)",
            PAPER["initial"],
            first,
            "chosen",
            "the stand-in is calibrated to it",
        ),
        Row("Table 8: eq. (40) at the optimum (J s)", PAPER["optimum"], result.value, "chosen", "of its own optimum"),
        Row("Table 8: eq. (40) at the paper's optimum (J s)", PAPER["optimum"], float(printed[2]), "chosen"),
        Row("Table 8: reduction (%)", 95.6, 100.0 * (1.0 - result.value / first), "chosen"),
        Row("Table 8: optimum (deg)", "1.06/-47/-47/1.06", angles([*x, *x[::-1]]), "chosen", "a flat valley"),
        Row("(41): largest violation of a peak", 0.0, result.violation, "chosen"),
        Row("Fig. 20: analyses", None, result.analyses, "chosen", f"{result.iterations} iterations"),
        Row("Figs. 22, 23: share of panel 2 in what is saved", "the major one", float(saved), "chosen"),
    ]


def vibration(folder: Path, rate: int) -> list[Row]:
    """Eq. (40) with modes of vibration, as the reference has them, beside Craig-Bampton, and finer meshes."""
    rows = []
    for name, printed in PAPER.items():
        cases: tuple[tuple[str, dict[str, Any]], ...] = (
            ("14 modes, 32x16 cells", {}),
            ("12 modes, 16x8 cells", {"modes": 12, "cells": (16, 8)}),
            ("24 modes, 16x8 cells", {"modes": 24, "cells": (16, 8)}),
            ("Craig-Bampton, 16x8 cells", MODEL),
            ("Craig-Bampton, 32x16 cells", MODEL | {"cells": (32, 16)}),
            ("Craig-Bampton, 64x32 cells", MODEL | {"cells": (64, 32)}),
        )
        for label, options in cases:
            motion = mbd.simulate(build(LAYUPS[name], **options), 3.0, steps=3 * rate, halvings=0, gradients="none")
            rows.append(Row(f"eq. (40), {name}, {label} (J s)", printed, shares(motion)[0], "chosen"))
    return rows


def deployment(folder: Path, rate: int, **model: Any) -> list[Row]:
    """Figs. 19, 24-26: interference, deflections and the angle of the actuator in phase 1, initial design and optimum."""
    names: tuple[str, ...] = ("initial", "optimum")
    designs = {ANGLES: torch.stack([mbd.deg(list(x)) for x in (START, OPTIMUM)])}
    motion = mbd.simulate(build(START, **model), 9.0, steps=9 * rate, designs=designs, halvings=0, gradients="none")
    rows, clearance = [], gaps(motion)
    for lane, name in enumerate(names):
        when = reaches_zero(motion, lane)
        rows.append(Row(f"Fig. 26: theta = 0, {name} (s)", "7 to 8", when, "chosen", f"ref. {REFERENCE_TIMES[name]} s"))
        for pair in ("panel 1 - panel 2", "panel 2 - panel 3"):
            least = 1e3 * float(clearance[pair][lane, motion.t <= when].min())
            paper = "interference" if (name, pair) == ("initial", "panel 1 - panel 2") else None
            rows.append(
                Row(f"Fig. 19: least gap, {pair}, {name} (mm)", paper, least, "chosen", "negative: interference")
            )
    lines: dict[str, Any] = dict(zip(names, theta(motion), strict=True))
    deflections: dict[str, dict[str, Any]] = {
        panel: dict(zip(names, motion.body(panel).at("corner_right_top").displacement[..., 2], strict=True))
        for panel in ("panel2", "panel3")
    }
    curves(motion.t, lines, "angle of the actuator [rad]", folder / "figure26.png")
    for number, (panel, curve) in zip((24, 25), deflections.items(), strict=True):
        curves(motion.t, curve, f"deflection of a corner of {panel} [m]", folder / f"figure{number}.png")
        most = {name: float(y[motion.t <= 7.0].abs().max()) for name, y in curve.items()}
        share = most["optimum"] / most["initial"]
        what = f"Fig. {number}: deflection of a corner of {panel} before 7 s, optimum over initial"
        rows.append(Row(what, "greatly reduced", share, "chosen", "the paper: 20 s, both phases; here the first"))
    return rows


_MODELS = tuple(f"experiments.models.sar_antenna{x}" for x in ("", "_bodies", "_data", "_clearance"))
SOURCES = (*_MODELS, "experiments.paper.antenna_tables")
PARTS = (
    Part("table6", "Table 6, Figs. 15-18: two lay-ups of the antenna", layups,
         (*SOURCES, "experiments.models.sar_antenna_whole", "experiments.paper.antenna"), 1.0, {"rate": 100, "modes": 14}),
    Part("table8", "Tables 7, 8, Figs. 20-23: the antenna optimized", optimum,
         (*SOURCES, "experiments.paper.antenna_optimum", "experiments.paper.antenna"), 3.0, {"steps": 300}),
    Part("equation40", "Eq. (40) with other modes and meshes", vibration,
         (*SOURCES, "experiments.paper.antenna"), 3.0, {"rate": 200}),
    Part("figures19_26", "Figs. 19, 24-26: the first phase of both designs", deployment,
         (*SOURCES, "experiments.paper.antenna"), 1.0, {"rate": 200, "modes": 14}),
)  # fmt: skip
