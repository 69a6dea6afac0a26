"""The antenna's first phase beside the paper and an independent code. `python -m experiments.paper.antenna_tables COMMAND`

    describe    bodies, joints, rank, redundant rows, freedoms of the whole antenna and of phase 1
    times       when theta reaches 0: rigid panels, lay-ups 1 and 2, initial and optimum design
    integrals   eq. (40) at the initial design and the optimum, share of panel 2, --study: reductions, modes, meshes
    failures    joints on arms of 50 mm, a stronger actuator: recognized as the failure of Fig. 17
    clearance   smallest distances of panels and trusses
    gradient    of eq. (40) at 40/-30 against differences of the same discrete map; --law sharp: jumps as located events
    animate     phase 1 as an HTML file

Reference: a C++ code with the data of models/sar_antenna.py, rigid trusses, 12 modes, 16 x 8 cells, 1 ms steps. Modes
of the two codes differ: 14 modes on 32 x 16 cells serve here, -2.3 % and -1.0 % of its integrals (--study). The stand-in
geometry was calibrated with that code to the paper's two integrals, so the columns say how far two codes agree; the
agreement with the paper is no reproduction.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from typing import Any

import torch

import torchmbd as mbd
from experiments.models.sar_antenna import build, jumps, phi3, theta
from experiments.models.sar_antenna_clearance import gaps, verdict
from experiments.models.sar_antenna_data import ANGLES, DURATION, INTEGRATOR, LAWS
from experiments.models.sar_antenna_whole import unlocked

LAYUPS: dict[str, tuple[float, float] | None] = {
    "rigid": None,
    "lay-up 1": (0.0, 0.0),
    "lay-up 2": (0.0, 90.0),
    "initial": (55.0, -55.0),
    "optimum": (1.06, -47.0),
}
REFERENCE_TIMES = {"rigid": 8.26, "lay-up 1": 8.18, "lay-up 2": 8.19, "initial": 7.99, "optimum": 8.19}
# eq. (40) [J s]: paper; reference with the continuous and with the printed law; its share of panel 2
PAPER = {"initial": 0.0219814, "optimum": 0.00097180}
REFERENCE = {
    "continuous": {"initial": 0.02175, "optimum": 0.00088},
    "printed": {"initial": 0.02385, "optimum": 0.00096},
}
SHARE = {"initial": 0.94, "optimum": 0.91}
# By `MODES`.
STUDY = {
    "initial": (0.02035, 0.02175, 0.02215, 0.02265),
    "optimum": (0.00086, 0.00088, 0.000965, 0.000995),
}
MODES, CELLS = (8, 12, 16, 24), ((16, 8), (32, 16), (64, 32))
STUDIED = (
    ("vibration", 14, CELLS[1]),  # that of experiments.models.sar_antenna.build
    *(("vibration", modes, CELLS[0]) for modes in MODES),
    *(("vibration", modes, cells) for modes in (12, 14, 16) for cells in CELLS[1:] if (modes, cells) != (14, CELLS[1])),
    *(("craig-bampton", modes, CELLS[0]) for modes in (4, 8)),
    *(("craig-bampton", 4, cells) for cells in CELLS[1:]),
)
ENERGY = {panel: mbd.StrainEnergy(panel) for panel in ("panel2", "panel3")}
OBJECTIVE = mbd.Integral(ENERGY["panel2"] + ENERGY["panel3"])  # eq. (40)
SOON = 0.02  # [rad] before the dead point, where a rigid parallelogram locks


def reaches_zero(motion: mbd.Trajectory, lane: int = 0) -> float:
    """Time at which theta comes to 0 [s], from where it passes `SOON` and its rate there; nan if it does not."""
    angle = theta(motion)[lane]
    passed = torch.nonzero(angle <= SOON)
    if not len(passed):
        return math.nan
    i = int(passed[0, 0])
    rate = float((angle[i] - angle[i - 1]) / (motion.t[i] - motion.t[i - 1]))
    return float(motion.t[i]) - float(angle[i]) / rate


def times(steps: int) -> None:
    """Print when theta reaches 0."""
    print("design     theta = 0 (s)  reference  difference")
    for name, angles in LAYUPS.items():
        motion = mbd.simulate(build(angles), 8.4, steps=round(8.4 * steps), halvings=0, gradients="none")
        deployed = reaches_zero(motion)
        print(
            f"{name:9s}  {deployed:13.2f}  {REFERENCE_TIMES[name]:9.2f}  {deployed - REFERENCE_TIMES[name]:+10.2f}",
            flush=True,
        )


def shares(motion: mbd.Trajectory) -> tuple[float, float]:
    """Eq. (40) [J s], and the share of panel 2."""
    parts = [float(mbd.Integral(energy).value(motion.require_ok())[0]) for energy in ENERGY.values()]
    return sum(parts), parts[0] / sum(parts)


def integrals(steps: int, study: bool, law: str, trusses: str) -> None:
    """Print eq. (40) beside the reference and the paper."""
    print(
        "design   reduction       modes  cells  law         trusses  eq. (40)   / reference  / paper  panel 2 (ref.)  s"
    )
    totals = {}
    for name, reference in REFERENCE["continuous" if law == "continuous" else "printed"].items():
        for reduction, modes, cells in STUDIED if study else STUDIED[:1]:
            start = time.perf_counter()
            system = build(LAYUPS[name], modes=modes, cells=cells, law=law, trusses=trusses, reduction=reduction)
            # More than 16 modes of vibration need finer steps: corners of the panels swing fast.
            often = steps * (2 if modes > 16 else 1)
            motion = mbd.simulate(
                system, DURATION, steps=round(DURATION * often), halvings=0, gradients="none", **INTEGRATOR[trusses]
            )
            total, share = shares(motion)
            totals.setdefault(name, total)
            print(
                f"{name}  {reduction:14s}  {modes:5d}  {cells[0]}x{cells[1]:<3d}  {law:10s}  "
                f"{trusses:7s}  {total:.6f}  {total / reference:11.3f}  {total / PAPER[name]:7.3f}  "
                f"{share:.3f} ({SHARE[name]})    {time.perf_counter() - start:8.1f}",
                flush=True,
            )
    print(f"reduction {100 * (1 - totals['optimum'] / totals['initial']):.1f} % (reference 96.0, paper 95.6)")
    if study:
        print(f"reference with {', '.join(map(str, MODES))} modes: {STUDY}")


def failures(steps: int) -> None:
    """Print what becomes of antennas that fail."""
    cases: dict[str, dict[str, Any]] = {
        "initial": {},
        "initial, arms of 50 mm": {"arm": 0.05},
        "lay-up 1, arms of 50 mm": {"arm": 0.05, "angles": (0.0, 0.0)},
        "lay-up 2, arms of 50 mm": {"arm": 0.05, "angles": (0.0, 90.0)},
        "optimum, arms of 50 mm": {"arm": 0.05, "angles": (1.06, -47.0)},
        "initial, twice the torque": {"strength": 2.0},
    }
    for name, options in cases.items():
        motion = mbd.simulate(build(**options), DURATION, steps=round(DURATION * steps), halvings=0, gradients="none")
        print(f"{name:26s} theta {theta(motion)[0, -1]:.2f}, panel 3 {phi3(motion)[0, -1]:.2f}: {verdict(motion)}")


def clearance(steps: int, duration: float) -> None:
    """Print the smallest gap of every pair over the motion, and when."""
    for name in ("initial", "optimum"):
        motion = mbd.simulate(
            build(LAYUPS[name]), duration, steps=round(duration * steps), halvings=0, gradients="none"
        )
        for pair, gap in gaps(motion).items():
            least, when = gap[0].min(0)
            verdict = "interference" if least < 0 else "clear"
            print(f"{name}  {pair:18s} {1e3 * float(least):8.2f} mm at {float(motion.t[when]):.2f} s  {verdict}")


def gradient(steps: int, angles: Sequence[float] = (40.0, -30.0), step: float = 1e-4, **options: Any) -> float:
    """Largest difference of the gradient of eq. (40) from central differences, over its largest entry; prints both."""
    located = options.get("law") == "sharp"
    system = build(angles, **options)
    settings: dict[str, Any] = {"steps": steps, "iterations": (5, 2)} | (
        {"phases": jumps()} if located else {"halvings": 0}
    )
    motion = mbd.simulate(system, DURATION, gradients="forward", variables=[ANGLES], **settings).require_ok()
    value, exact = OBJECTIVE.value_and_gradient(motion)
    assert exact is not None
    offsets = step * torch.cat([torch.eye(2, dtype=exact.dtype), -torch.eye(2, dtype=exact.dtype)])
    designs = {ANGLES: mbd.deg(list(angles)) + offsets}
    f = OBJECTIVE.value(mbd.simulate(system, DURATION, designs=designs, gradients="none", **settings).require_ok())
    differences = (f[:2] - f[2:]) / (2 * step)
    error = float((exact[0] - differences).abs().max() / differences.abs().max())
    print(f"J {float(value):.6g} J s, gradient {exact[0].tolist()}, differences {differences.tolist()}: {error:.1e}")
    return error


def animate(path: str, name: str, duration: float, steps: int) -> None:
    """Write the first phase as an HTML file."""
    motion = mbd.simulate(build(LAYUPS[name]), duration, steps=round(duration * steps), halvings=0, gradients="none")
    print(mbd.viz.animate(motion, path, title=f"SAR antenna, phase 1, {name}"))


def main() -> None:
    """Run one command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = ("describe", "times", "integrals", "failures", "clearance", "gradient", "animate")
    parser.add_argument("command", choices=commands)
    parser.add_argument("--steps", type=int, default=200, help="steps per second; 200 are within 0.1 %% of 1000")
    parser.add_argument("--study", action="store_true", help="integrals: other numbers of modes and finer meshes")
    parser.add_argument("--trusses", choices=tuple(INTEGRATOR), default="rigid")
    parser.add_argument("--law", choices=tuple(LAWS), default="continuous")
    parser.add_argument("--design", choices=tuple(LAYUPS), default="initial", help="animate: which")
    parser.add_argument("--duration", type=float, default=DURATION, help="clearance, animate [s]")
    parser.add_argument("--output", default="sar_antenna.html")
    arguments = parser.parse_args()
    if arguments.command == "describe":
        print(unlocked().describe(), build(LAYUPS[arguments.design]).describe(), sep="\n\nPhase 1\n")
    elif arguments.command == "times":
        times(arguments.steps)
    elif arguments.command == "integrals":
        integrals(arguments.steps, arguments.study, arguments.law, arguments.trusses)
    elif arguments.command == "failures":
        failures(arguments.steps)
    elif arguments.command == "clearance":
        clearance(arguments.steps, arguments.duration)
    elif arguments.command == "gradient":
        gradient(round(DURATION * arguments.steps), law=arguments.law)
    else:
        animate(arguments.output, arguments.design, arguments.duration, arguments.steps)


if __name__ == "__main__":
    main()
