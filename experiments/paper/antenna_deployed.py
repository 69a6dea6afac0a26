"""Parts of section 6 over both phases: Figs. 14, 19, 22-26 for 20 s, rigid and flexible panels, rigid and flexible trusses.

The second phase is chosen altogether, but for its counts (experiments/models/sar_antenna_whole.py): the paper prints nothing
of it.
Checked in tests/experiments/test_paper.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.models.sar_antenna import theta
from experiments.models.sar_antenna_clearance import gaps
from experiments.models.sar_antenna_whole import DESIGNS, deployed, hinges
from experiments.paper.antenna import SOURCES, curves
from experiments.paper.part import Part, Row

NODES = {"panel2": "B", "panel3": "D"}  # as the paper calls the corners of Figs. 24, 25
LAST = 1.5  # [s]
PAIRS = ("panel 1 - panel 2", "panel 2 - panel 3")


def rigid(folder: Path, steps: int) -> list[Row]:
    """Fig. 14: both phases with rigid panels, and how well these are in line after 20 s."""
    motion = deployed(steps=steps)
    curves(motion.t, {name: angle[0] for name, angle in hinges(motion).items()}, "angle of the hinge [rad]",
           folder / "figure14.png")  # fmt: skip
    note = "second loop, actuator B, latches are chosen"
    return [Row("both phases, rigid panels", "deploys", ended(motion, 0), "chosen", note), *aligned(motion, 0, "rigid")]


def flexible(folder: Path, steps: int, trusses: str = "rigid", **options: Any) -> list[Row]:
    """Figs. 22-26 over both phases, 20 s: initial design, the paper's optimum, ours."""
    motion = deployed(list(DESIGNS.values()), steps, trusses=trusses, **options)
    rows = []
    for lane, name in enumerate(DESIGNS):
        rows.append(Row(f"both phases, {name}", "deploys", ended(motion, lane), "chosen", f"{trusses} trusses"))
        times = ", ".join(f"{float(switch.t[lane]):.2f}" for switch in motion.switches)
        rows.append(Row(f"joint A locked, D and E released, joint B locked, {name} (s)", None, times, "chosen"))
        rows += aligned(motion, lane, name)
    suffix = "" if trusses == "rigid" else ", flexible trusses"
    energy = {panel: motion.body(panel).strain_energy for panel in NODES}
    bent = {panel: motion.body(panel).at("corner_right_top").displacement[..., 2] for panel in NODES}
    for number, (panel, node) in zip((22, 23), NODES.items(), strict=True):
        rows += compared(f"Fig. {number}: peak energy of {panel}", energy[panel])
        draw(motion, energy[panel], f"energy of {panel} [J]", folder / f"figure{number}_both phases{suffix}.png")
        rows += compared(f"Fig. {number + 2}: deflection of node {node}", bent[panel].abs())
        draw(
            motion,
            bent[panel],
            f"deflection of node {node} [m]",
            folder / f"figure{number + 2}_both phases{suffix}.png",
        )
    draw(motion, theta(motion), "angle of actuator A [rad]", folder / f"figure26_both phases{suffix}.png")
    clearance = gaps(motion)
    for pair in PAIRS:
        least = [f"{1e3 * float(gap.min()):.1f}" for gap in clearance[pair]]
        note = "stowed wider than in phase 1 alone" if pair == PAIRS[0] else ""
        rows.append(Row(f"least gap, {pair}, {', '.join(DESIGNS)} (mm)", None, ", ".join(least), "chosen", note))
    return rows


def ended(motion: mbd.Trajectory, lane: int) -> str:
    """What became of the deployment."""
    return "deploys" if motion.status[lane] == "ok" else motion.status[lane]


def aligned(motion: mbd.Trajectory, lane: int, name: str) -> list[Row]:
    """How well the panels are in line at the end: section 6.1 asks for 0.5 degrees. They still vibrate."""
    rows = []
    for pair, angle in hinges(motion).items():
        last = torch.rad2deg(angle[lane, motion.t >= motion.t[-1] - LAST])
        note = f"in the last {LAST:g} s {float(last.min()):.2f} to {float(last.max()):.2f}"
        what = f"mean angle of {pair} at the end, {name} (deg)"
        rows.append(Row(what, "within 0.5", float(last.mean()), "chosen", note))
    return rows


def compared(what: str, x: Tensor) -> list[Row]:
    """The largest value of each design over that of the initial one."""
    most = x.amax(1)
    largest: Mapping[str, Any] = dict(zip(DESIGNS, most.tolist(), strict=True))
    rows = [Row(f"{what}, initial, both phases", None, largest["initial"], "chosen")]
    return rows + [
        Row(f"{what}, {name} over initial", "greatly reduced", value / largest["initial"], "chosen")
        for name, value in largest.items()
        if name != "initial"
    ]


def draw(motion: mbd.Trajectory, x: Tensor, ylabel: str, path: Path) -> None:
    """The initial design and the paper's optimum over time."""
    curves(motion.t, dict(zip(DESIGNS, x, strict=True)), ylabel, path)


_PHASES = (
    *SOURCES,
    "experiments.models.sar_antenna_whole",
    "experiments.paper.antenna",
    "experiments.paper.antenna_deployed",
)
PARTS = (
    Part("figure14", "Fig. 14: both phases, rigid panels", rigid, _PHASES, 1.0, {"steps": 400}),
    Part("both_phases", "Figs. 22-26: both phases for 20 s, flexible panels", flexible, _PHASES, 2.0, {"steps": 4000}),
    Part("both_phases_trusses", "Both phases for 20 s, flexible panels, trusses of wound tubes", flexible, _PHASES, 5.0,
         {"steps": 4000, "trusses": "tube", "modes": 12}),
)  # fmt: skip
