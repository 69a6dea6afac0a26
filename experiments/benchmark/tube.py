"""A round tube with any number of modes: designs that fail, and the searches of the default method.

Bending of a round tube comes in pairs of equal frequency, and torsion passes the pairs as the ply angles change. A number of
modes that would separate a pair in some design must not lose that design.

The first tube has three ply angles and one thickness: least mass under a frequency, a ply failure and two deflections of a
swing. Its optimum is known from a scan and from a model of slender beams: 0.101 kg with all fibers along the tube. The second
tube has two plies, other radii and another length. Random designs have angles between -90 and 90 degrees.

Checked in tests/experiments/test_benchmark.py.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import torch

import torchmbd as mbd
from experiments.benchmark.report import Cell, Grid, Result, Settings

MODES, OTHER_MODES = (4, 5, 6, 7, 8, 12), (3, 4, 5, 6, 7, 8, 9, 10)
DESIGNS, OTHER_DESIGNS = 33, 40
STARTS, SEED = 4, 3


def tube(
    modes: int, angles: Sequence[float], radii: tuple[float, float], length: float, elements: int = 4
) -> mbd.System:
    """A driven hub, a spring about its hinge, a tapered tube and a mass at its tip.

    angles   of the plies, from the inside [degrees]
    radii    outer ones, at both ends [m]
    """
    strength = mbd.Strength(Xt=1.5e9, Xc=1.2e9, Yt=50e6, Yc=250e6, S12=70e6)
    carbon = mbd.Ply(
        E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.3, density=1586.0, strength=strength
    )
    wall, plies = mbd.variable(0.25e-3), torch.nn.Parameter(mbd.deg(list(angles)))
    middles = np.interp((np.arange(elements) + 0.5) / elements, [0.0, 1.0], radii)
    sections = [mbd.sections.tube(r, carbon, plies, thickness=wall, cells=(12, 1)) for r in middles]
    line = mbd.BeamLine.straight(length, elements=elements)
    arm = mbd.FlexibleBody.beam(
        "arm", line, sections, modes=modes, position=(0.1, 0, 0), reference="start", damping=0.005
    )
    hub = mbd.RigidBody("hub", mass=2.0, inertia=(0.01, 0.01, 0.01))
    tip = mbd.RigidBody("tip", mass=0.3, inertia=(2e-4, 2e-4, 2e-4), position=(0.1 + length, 0, 0))
    ground, hinge = mbd.Ground(), hub.at(0.1, 0, 0)
    joints = [
        mbd.Revolute(ground.at(), hub.at(), axis="z", name="shaft"),
        mbd.Drive(ground, hub, axis="z", angle=swing, name="motor"),
        mbd.Revolute(hinge, arm.at("start"), axis="z", name="hinge"),
        mbd.Fixed(arm.at("end"), tip.at(), name="clamp"),
    ]
    lag = mbd.RotationalSpringDamper(hinge, arm.at("start"), axis="z", stiffness=4000.0, damping=2.0, name="lag")
    return mbd.System([hub, arm, tip], joints, [lag], gravity=(0, 0, -9.81))


def swing(t: torch.Tensor, rate: float = 60.0, rise: float = 0.2) -> torch.Tensor:
    """Angle whose second derivative rises from 0 to `rate` [1/s2] in `rise` [s] and falls to 0 again [rad]."""
    s = (t / rise).clamp(0.0, 2.0)
    up, down = s**3 / 6.0, s**2 - s**3 / 6.0 - s + 1.0 / 3.0
    return rate * rise**2 * (torch.where(s < 1.0, up, down) + (t / rise - 2.0).clamp(min=0.0))


def problem(system: mbd.System, duration: float = 0.6, steps: int = 120) -> mbd.Problem:
    sway, sag = mbd.Displacement("arm", "y", node="end", seen_from="hub"), mbd.Displacement("arm", "z", node="end")
    limits = [
        mbd.vibrations.SystemFrequency(1) >= 11.0,
        mbd.Max(mbd.PlyFailure("arm")) <= 0.3,
        mbd.Max(abs(sway)) <= 0.016,
        mbd.Max(abs(sag)) <= 2e-3,
    ]
    bounds = {"arm.section0.angles": mbd.deg([-90, 90]), "arm.section0.thickness": (0.1e-3, 1e-3)}
    return mbd.Problem(system, duration, steps=steps, minimize=mbd.Mass("arm"), subject_to=limits, bounds=bounds)


def first(modes: int) -> mbd.System:
    return tube(modes, [45.0, -45.0, 0.0], (0.030, 0.015), 1.2)


def second(modes: int) -> mbd.System:
    return tube(modes, [30.0, -60.0], (0.022, 0.018), 0.8)


def failures(system: mbd.System, count: int) -> int:
    """How many of `count` random designs have no motion of four steps."""
    short = problem(system, 0.02, 4)
    random = np.random.default_rng(0)
    walls, angles = random.uniform(0.1e-3, 0.4e-3, count), random.uniform(-1.57, 1.57, (count, short.start.size - 1))
    return sum(not e.ok for e in short.evaluate(np.column_stack([walls, angles]), False))


def round_tube(settings: Settings) -> Result:
    """Designs that fail, and one search by the default method for each number of modes of the first tube."""
    several = {"first tube": (first, MODES, DESIGNS), "second tube": (second, OTHER_MODES, OTHER_DESIGNS)}
    failed: list[list[Cell]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of coarse steps
        for name, (make, numbers, designs) in several.items():
            count = 3 if settings.quick else designs
            for modes in numbers[2:3] if settings.quick else numbers:
                failed.append([name, modes, failures(make(modes), count), count])
        searches = [] if settings.quick else [_search(modes) for modes in MODES]
    columns = ["modes", "kg", "largest angle", "simulations", "failed", "status"]
    return Result(
        tables=[
            Grid("random designs that fail", ["what", "modes", "failed", "of"], failed),
            Grid("first tube: searches from its start, default method", columns, searches),
        ]
    )


def _search(modes: int) -> list[Cell]:
    result = mbd.optimize(problem(first(modes)), progress=False)
    angle = float(np.degrees(np.abs(result.x[1:])).max())
    return [modes, result.value, angle, result.analyses, result.failures, result.status]


def tube_starts(settings: Settings) -> Result:
    """Several starts of the default method for each number of modes of the first tube."""
    rows: list[list[Cell]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for modes in () if settings.quick else MODES:
            starts = mbd.optimization.sobol(STARTS, seed=SEED, include_initial=True)
            results = mbd.optimization.multistart(problem(first(modes)), starts=starts, progress=False).results
            rows += [[modes, k, r.value, r.analyses, r.failures, r.status] for k, r in enumerate(results)]
    columns = ["modes", "start", "kg", "simulations", "failed", "status"]
    return Result(tables=[Grid("first tube: several starts, default method", columns, rows)])
