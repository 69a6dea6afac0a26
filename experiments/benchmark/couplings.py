"""Cost of a coupling of two joints beside that of a revolute joint: processor time of a step, native, in one process.

coupling_ratio    added time of a coupling over that of a revolute joint, in a chain of LINKS rigid links

Twelve bodies without joints, the chain that revolute joints make of them, and the chain whose neighboring angles are coupled.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import torchmbd as mbd
from experiments.benchmark.cases import compilation, interleaved
from experiments.benchmark.report import Cell, Grid, Result, Settings
from torchmbd.extensions.native.codegen.compiler import unavailable

LINKS, STEPS, REPEATS = 12, 500, 4  # REPEATS: of a run, beside those of the settings, as one takes 30 ms
LENGTH, DURATION = 0.5, 0.5  # m, s


def chain(links: int, joints: bool, couplings: bool) -> mbd.System:
    """Rigid links in a row, each with a torque; joined by revolute joints or not; neighboring angles coupled or not."""
    bodies = [
        mbd.RigidBody(f"link{k}", 1.0 + 0.1 * k, (0.04, 0.04, 0.04), position=(k * LENGTH, 0.0, 0.0))
        for k in range(links)
    ]
    pushes = [mbd.Torque(body.at(), (0.0, 0.0, 0.5), name=f"push{k}") for k, body in enumerate(bodies)]
    if not joints:
        return mbd.System(bodies, [], pushes, free=[body.name for body in bodies])
    ends = [mbd.Ground().at(), *(body.at(0.5 * LENGTH, 0.0, 0.0) for body in bodies)]
    starts = [bodies[0].at(), *(body.at(-0.5 * LENGTH, 0.0, 0.0) for body in bodies[1:])]
    hinges = [mbd.Revolute(a, b, name=f"hinge{k}") for k, (a, b) in enumerate(zip(ends, starts, strict=False))]
    gears = [
        mbd.JointCoupling([a.angle, b.angle], [1.0 + 0.1 * k, 1.0], name=f"gear{k}")
        for k, (a, b) in enumerate(pairwise(hinges))
    ]
    return mbd.System(bodies, [*hinges, *(gears if couplings else [])], pushes)


def couplings(settings: Settings) -> Result:
    """See the module header."""
    if unavailable() is not None and not settings.quick:
        return Result({"coupling_ratio": None})
    links, steps = (3, 5) if settings.quick else (LINKS, STEPS)
    kinds = {"no joints": (False, False), "revolute joints": (True, False), "and couplings": (True, True)}
    functions: dict[str, Callable[[], None]] = {
        name: partial(_run, chain(links, *kind), steps) for name, kind in kinds.items()
    }
    with compilation(not settings.quick):
        for function in functions.values():
            function()
        seconds = interleaved(functions, settings.repeat if settings.quick else REPEATS * settings.repeat)
    free, hinged, coupled = (1e6 * seconds[name] / steps for name in kinds)
    hinge, gear = (hinged - free) / links, (coupled - hinged) / (links - 1)
    rows: list[list[Cell]] = [
        [name, 1e6 * seconds[name] / steps, each] for name, each in zip(kinds, (None, hinge, gear), strict=True)
    ]
    columns = ["chain", "microseconds per step", "per joint that was added"]
    return Result(
        {"coupling_ratio": None if settings.quick else gear / hinge},
        [Grid(f"couplings in a chain of {links} links", columns, rows)],
    )


def _run(system: mbd.System, steps: int) -> None:
    mbd.simulate(system, DURATION * steps / STEPS, steps=steps, gradients="none").require_ok()
