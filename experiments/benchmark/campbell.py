"""A Campbell diagram: eight frequencies of a blade of 20 exact beam elements on a hub with a motor at 50 speeds.

values_s     states of rotation, eigenvalues and clearances [s]
gradient     time of values and their gradient by 100 variables over that of values
"""

from __future__ import annotations

from itertools import count

import torch

import torchmbd as mbd
from experiments.benchmark.cases import interleaved
from experiments.benchmark.report import Grid, Result, Settings
from torchmbd.optimization.optimizer import Evaluation

SPEEDS, MODES, PLIES = 50, 8, 50


def blade() -> mbd.System:
    """A laminated strip of 50 plies, 2 m long, whose angles and thicknesses are variables, and a hub."""
    ply = mbd.Ply(E1=140e9, E2=10e9, G12=5e9, G13=5e9, G23=4e9, nu12=0.3, density=1600.0)
    angles = torch.linspace(-1.2, 1.3, PLIES, dtype=torch.float64)
    thickness = torch.nn.Parameter(torch.full((PLIES,), 2.5e-4, dtype=torch.float64))
    section = mbd.sections.strip(0.1, ply, angles, thickness, cells=(4, 1))
    beam = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(2.0, 20), section)
    ground, hub = mbd.Ground(), mbd.RigidBody("hub", 1.0, (0.1, 0.1, 0.1))
    joints = [
        mbd.Revolute(ground.at(), hub.at(), axis="z", name="bearing"),
        mbd.Drive(ground.at(), hub.at(), axis="z", speed=10.0, name="motor"),
        mbd.Fixed(hub.at(), beam.at("start"), name="root"),
    ]
    return mbd.System([hub, beam], joints)


def campbell(settings: Settings) -> Result:
    """See the module header."""
    system, points = blade(), 3 if settings.quick else SPEEDS
    clearance = mbd.vibrations.CampbellClearance((1.0, 2.0, 3.0), (5.0, 40.0), tuple(range(1, MODES + 1)), points)
    names = [name for name, x in system.named_parameters() if x.numel() == PLIES]
    problem = mbd.Problem(
        system, 1e-5, mbd.Mass("blade"), [clearance >= 0.05], variables=names, start=None, steps=2, gradients="reverse"
    )
    number = count()

    def run(gradient: bool) -> list[Evaluation]:
        design = problem.start[None] * (1.0 + 1e-9 * next(number))  # what is known of the last design does not count
        return problem.evaluate(design, gradient)

    evaluate = {"values": lambda: run(False), "gradient": lambda: run(True)}
    assert all(once()[0].status == "ok" for once in evaluate.values())
    seconds = interleaved(evaluate, settings.repeat)
    ratio = seconds["gradient"] / seconds["values"]
    rows = [[name, x] for name, x in seconds.items()]
    return Result(
        {"values_s": seconds["values"], "gradient": ratio},
        [Grid(f"{points} speeds, processor seconds", ["what", "s"], rows)],
    )
