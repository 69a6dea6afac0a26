"""A spatial arm whose measurements are made by the model itself: how often do intervals of 95 % hold the truth?

    unknown    E1, E2, G12 of the plies of both tubes, their damping ratios, the stiffness of the elbow, the mass of the tool,
               and the delay of the accelerometers; the angles of the six plies are known
    measured   accelerations of the tool, the angle of the elbow, the torque of the shoulder's drive; noise: 1 % of their spread
    move       the shoulder turns by 40 degrees within 0.2 s, then the arm vibrates on its elastic elbow

Chosen, no publication. `python -m experiments.models.arm_twin 100` makes a hundred draws and fits from 30 % off.
Checked in tests/experiments/test_arm_twin.py.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from torchmbd.design.curve import curve_of
from torchmbd.extensions.identification.fit_problem import FitProblem, Residuals
from torchmbd.extensions.identification.least_squares import FitSettings, fit_start
from torchmbd.extensions.identification.losses import linear
from torchmbd.optimization.multistart.batched import BatchedSearches
from torchmbd.optimization.units import variable_scale

END, STEPS = 0.3, 150  # [s]: longer, and vibrations that are 30 % off would be compared cycle by wrong cycle
SMALL = (1e-4, 1e-4, 1e-4)
TRUTH = {
    "upper.section.ply.E1": 128e9,
    "upper.section.ply.E2": 10.1e9,
    "upper.section.ply.G12": 5.36e9,
    "upper.damping.ratios": 0.02,
    "fore.damping.ratios": 0.03,
    "elbow.stiffness": 300.0,
    "tool.mass": 0.5,
}
DELAY = 2e-3  # [s]
CHANNELS: dict[str, mbd.History] = {
    "ax": mbd.Acceleration("tool", "x"),
    "ay": mbd.Acceleration("tool", "y"),
    "az": mbd.Acceleration("tool", "z"),
    "angle": mbd.Angle("lift", "y", seen_from="joint"),
    "torque": mbd.Reaction("turn", "z", "torque"),
}
ACCELEROMETERS = ("ax", "ay", "az")
OFF = [0.7, 1.3, 0.7, 1.3, 0.7, 1.3, 1.3]  # times the truth, of the start


def build(values: Sequence[float] = tuple(TRUTH.values())) -> mbd.System:
    """The arm with these values of the unknowns of TRUTH."""
    E1, E2, G12, upper_ratio, fore_ratio, stiffness, mass = (mbd.variable(x) for x in values)
    ply = mbd.Ply(E1=E1, E2=E2, G12=G12, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    # Unbalanced plies: bending, torsion and their coupling tell the three moduli apart.
    upper = _tube("upper", 0.5, 0.012, 0.25, ply, [25.0, -40.0, 70.0], upper_ratio)
    fore = _tube("fore", 0.4, 0.009, 0.7, ply, [10.0, 55.0, -35.0], fore_ratio)
    hub = mbd.RigidBody("hub", 1.0, SMALL)
    joint, lift = mbd.RigidBody("joint", 0.3, SMALL, (0.5, 0, 0)), mbd.RigidBody("lift", 0.1, SMALL, (0.5, 0, 0))
    center = (0.0, 0.02, 0.01)  # of the tool, beside the tube, which it twists
    tool = mbd.RigidBody("tool", mass, SMALL, position=(0.9, 0, 0), center=center)
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), hub.at(), axis="z", name="shoulder"),
        mbd.Drive(ground, hub, axis="z", angle=mbd.SmoothStep(mbd.deg(40), 0.2), name="turn"),
        mbd.Fixed(hub.at(), upper.at("start"), name="root"),
        mbd.Fixed(upper.at("end"), joint.at(), name="housing"),
        mbd.Revolute(joint.at(), lift.at(), axis="y", name="hinge"),
        mbd.Fixed(lift.at(), fore.at("start"), name="clamp"),
        mbd.Fixed(fore.at("end"), tool.at(), name="grip"),
    ]
    spring = mbd.RotationalSpringDamper(joint.at(), lift.at(), "y", stiffness=stiffness, damping=0.4, name="elbow")
    return mbd.System([hub, upper, joint, lift, fore, tool], joints, [spring], gravity=(0, 0, -9.81))


def _tube(
    name: str, length: float, radius: float, at: float, ply: mbd.Ply, degrees: list[float], ratio: torch.nn.Parameter
) -> mbd.FlexibleBody:
    """A tube of three plies along x with a damping ratio of its modes; `at`: where its middle is."""
    section = mbd.sections.tube(radius, ply, mbd.deg(degrees), 0.3e-3, cells=(8, 1))
    body = mbd.FlexibleBody.beam(
        name,
        mbd.BeamLine.straight(length, 4),
        section,
        modes=0,
        reduction="craig-bampton",
        interface=["end"],
        position=(at, 0, 0),
        reference="start",
    )
    return body.damped(ratio)


def measured(count: int = 150) -> dict[str, np.ndarray]:
    """What perfect sensors show of the true arm [count], accelerations late by DELAY."""
    t = np.linspace(0.01, 0.29, count)
    motion = mbd.simulate(build(), END, steps=STEPS, gradients="none", start="equilibrium")
    result = {"t": t}
    for name, response in CHANNELS.items():
        curve = curve_of(motion, lambda part, _, y=response: (y.values(part), y.rates(part)))
        at = t - DELAY if name in ACCELEROMETERS else t
        result[name] = curve.at(torch.from_numpy(at))[0].numpy()
    return result


def experiment(clean: dict[str, np.ndarray], noise: float = 0.01) -> mbd.identification.Experiment:
    """The arm with values that are 30 % off, and what was measured."""
    delay, channels = mbd.variable(0.0), {}
    for name, response in CHANNELS.items():
        late = delay if name in ACCELEROMETERS else 0.0
        channels[name] = mbd.identification.Channel(response, deviation=noise * clean[name].std(), delay=late)
    start = build([x * off for x, off in zip(TRUTH.values(), OFF, strict=True)])
    return mbd.identification.Experiment(
        start, mbd.identification.TimeSeries(clean, channels), duration=END, steps=STEPS, start="equilibrium"
    )


def draws(count: int) -> list[mbd.identification.Identification]:
    """Fits of `count` draws of the noise. What the model shows does not depend on them: all fits are lanes of one batch."""
    problem = FitProblem({"arm": experiment(measured())}, list(TRUTH), {"ax.delay": (-0.004, 0.008)})
    scale = variable_scale(problem.start, problem.lower, problem.upper)
    settings = FitSettings(problem.lower, problem.upper, scale, problem.data, linear, 1.0, 1e-5, 50)
    noise = np.random.default_rng(0).standard_normal((count, problem.data))

    def runner(index: int, evaluate: Any, report: Any) -> Any:
        def residuals(X: np.ndarray, gradients: bool) -> list[Residuals]:
            return [replace(x, values=x.values - noise[index]) for x in evaluate(X, gradients)]

        return fit_start(residuals, problem.start, settings, index, report)

    fits: Any = BatchedSearches(problem, [partial(runner, k) for k in range(count)], max_lanes=count).run()  # type: ignore[arg-type]
    return [
        mbd.identification.Identification(problem, settings, fit, [fit], fit.evaluations, fit.failures) for fit in fits
    ]


def main(count: int = 100) -> np.ndarray:
    """How many of `count` draws have the truth within the interval, of each unknown."""
    results, truth = draws(count), np.array([*TRUTH.values(), DELAY])
    inside = np.sum([(x.interval[:, 0] <= truth) & (truth <= x.interval[:, 1]) for x in results], axis=0)
    for name, number, value, size in zip(results[0].names, inside, truth, results[0].deviation, strict=True):
        print(f"{name:<28} {number} of {count} within 95 %, deviation {100.0 * size / value:.2g} %")
    evaluations = [x.evaluations for x in results]
    print(f"Jacobians of a fit: {min(evaluations)} to {max(evaluations)}, {np.mean(evaluations):.1f} in the mean")
    print(f"converged: {sum(x.converged for x in results)}")
    return inside


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
