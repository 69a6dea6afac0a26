"""The whole half of the antenna: 12 bodies, 16 spherical and 3 revolute joints, three planar loops, both phases.

    loop 3   panel 2, panel 3, crank at R3, two rods                        phase 1, actuator A (sar_antenna.py)
    loop 2   panel 1, panel 2, rocker at R2, two rods                       like loop 3
    loop 1   panel 1, rocker, driver at R1, two rods                        phase 2, actuator B at R1

    freedoms by count 6 * 11 - (16 * 3 + 3 * 5) = 3; five rows depend on others: rank 58, mobility 8 = 2 + 6 spins of rods

    phase 1    D and E hold panel 2; A unfolds panel 3 until the crank is `LATCH` before the line of panel 2
    rest       joint A and the rods are locked
    phase 2    D and E are released; B swings both panels out until the rocker is `LATCH` before the line of panel 1
    phase 3    joint B and the rods are locked

phi2, phi3   angle of panel 2 from panel 1, of panel 3 from panel 2, about Y [rad]: 0 in line

In line is a dead point, where rods cannot hold a panel. So stops brake the ends of both ways, and at `LATCH` the rods of a
loop are locked with their crank and hold the panel across its plane (L7, L8; L11, L12 instead of S7, S8; S11, S12).
The other dead point is folded flat: panels that bend would drive the rocker through it, so the stack is stowed `OPENED`.
The counts are given; places of the second and first loop, actuator B, stops and latches are chosen: joints in the
mid-surfaces, R2 at the center of panel 1, B like A and stronger, for it moves both panels. Trusses of loops 1 and 2 are rigid.
Panels that bend need steps of 5 ms and a spectral radius of 0.7: latched, they ring against many constraints, and with 0.9
and 10 ms the ringing grows.
Checked in tests/experiments/test_sar_antenna_whole.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.models.sar_antenna import build, phi3, theta, turned
from experiments.models.sar_antenna_bodies import Panel, Truss, folded
from experiments.models.sar_antenna_data import ANGLES, CRANK, HALF, INTEGRATOR, MIDDLE, ROD_POINT
from torchmbd.multibody.forces import Gap, Spring, Table

DRIVER_AT, DRIVER, HANDLE = -1.8, 0.5, 0.2  # X of R1, length of the driver, half width of its handle [m]
DAMPING = 1.0  # of actuator B [N m s]
PULL = ((0.0, -1.8), (0.6, -25.0), (2.77, -25.0), (3.0, -12.0))  # its torque on the driver over its angle [rad, N m]
# Stops: parts of an actuator's way, from its end, that are damped [rad], and how much [N m s].
STOPS = {"A": ((1.5, 16.0),), "B": ((2.25, 108.0), (0.16, 134.0))}
RATIO = 0.01  # damping of the panels' modes
OPENED = 3.0  # angle of panel 2 from panel 1 when stowed: at 3.14 loops 1 and 2 have a dead point, too [rad]
LATCH = 0.004  # before the dead point [rad]
REST = 0.25  # in which D and E hold panel 2 and joint A is locked [s]
FLEXIBLE: dict[str, Any] = {"spectral_radius": 0.7, "iterations": (4, 1)}
DESIGNS = {"initial": (55.0, -55.0), "paper's optimum": (1.06, -47.0), "optimum": (8.66, -48.32)}  # [deg]
DURATION = 20.0  # of both phases, as in Figs. 24, 25 [s]


def whole(angles: Sequence[float] | None = None, **options: Any) -> mbd.System:
    """The stowed antenna with D and E; trusses rigid; `angles`, `options`: of experiments.models.sar_antenna.build."""
    first, ground, truss = build(angles, stowed=OPENED, **options), mbd.Ground(), Truss()
    panel2, panel3 = (Panel(first.body(name), 0.0) for name in ("panel2", "panel3"))
    if angles is not None:
        for panel in (panel2, panel3):
            panel.body.damped(RATIO)
    S, flat = {joint.name: joint for joint in first.joints}, folded(OPENED)
    hub, base = (
        torch.tensor([-HALF, 0.0, 0.0], dtype=torch.float64),
        torch.tensor([DRIVER_AT, 0, 0], dtype=torch.float64),
    )
    tip, elbow, grip = hub + CRANK * flat[:, 0], hub + DRIVER * flat[:, 0], base + DRIVER * flat[:, 0]
    rocker, rocker_hub, rocker_tip = truss.between("rocker", hub, tip)
    driver, driver_hub, _ = truss.between("driver", base, grip)
    bodies: list[Any] = [rocker, driver]
    joints: list[Any] = [
        mbd.Revolute(ground.at(*base.tolist()), driver_hub, axis="y", name="R1"),
        mbd.Revolute(ground.at(*hub.tolist()), rocker_hub, axis="y", name="R2"),
    ]
    for k, side in enumerate((-1, 1)):
        y = side * ROD_POINT[1]
        there = HALF * flat[:, 0] + flat @ torch.tensor([ROD_POINT[0], y, 0.0], dtype=torch.float64)
        rod, start, end = truss.between(f"rod2{'ab'[k]}", tip, there)
        joints += [
            mbd.Spherical(rocker_tip, start, name=f"S{9 + k}"),
            mbd.Spherical(end, panel2.at(ROD_POINT[0], y), name=f"S{11 + k}"),
            mbd.PointOnPlane(end, panel2.at(ROD_POINT[0], y), name=f"L{11 + k}"),
            mbd.PointOnPlane(S[f"S{7 + k}"].a, S[f"S{7 + k}"].b, name=f"L{7 + k}"),
        ]
        handle = torch.tensor([0.0, side * HANDLE, 0.0], dtype=torch.float64)
        link, start, end = truss.between(f"rod1{'ab'[k]}", grip + handle, elbow)
        joints += [
            mbd.Spherical(driver.at(DRIVER, side * HANDLE, 0.0), start, name=f"S{13 + k}"),
            mbd.Spherical(end, rocker.at(DRIVER), name=f"S{15 + k}"),
        ]
        bodies += [rod, link]
    foot = ground.at(*base.tolist())
    actuator = mbd.RotationalSpringDamper(driver_hub, foot, axis="y", law=Spring(0.0, DAMPING, MIDDLE), name="B")
    brakes = [*stops("A", S["R3"].a, S["R3"].b), *stops("B", driver_hub, foot)]
    return mbd.System([*first.bodies, *bodies], [*first.joints, *joints], [*first.forces, actuator, *brakes])


def unlocked() -> mbd.System:
    """The rigid antenna without D and E: the joints that the paper counts."""
    system = whole()
    return system.with_joints([joint for joint in system.joints if joint.name[0] in "RS"])


def stops(name: str, a: mbd.Frame, b: mbd.Frame) -> list[mbd.RotationalSpringDamper]:
    """What damps the end of an actuator's way; b turns to 0."""
    laws = [Gap(0.0, soft, damping=damping, smooth=soft, center=MIDDLE) for soft, damping in STOPS[name]]
    return [mbd.RotationalSpringDamper(a, b, axis="y", law=law, name=f"{name}_stop{k}") for k, law in enumerate(laws)]


def deployed(designs: Sequence[Sequence[float]] | None = None, steps: int = 4000, **options: Any) -> mbd.Trajectory:
    """Both phases for 20 s.

    designs   theta1, theta2 of the panels [deg], one design for each lane; None: rigid panels
    options   of experiments.models.sar_antenna.build
    """
    if designs is None:
        return mbd.simulate(
            whole(**options), DURATION, steps=steps, phases=phases(), iterations=(5, 1), gradients="none"
        )
    angles = torch.stack([mbd.deg(list(design)) for design in designs])
    system = whole(designs[0], **options)
    settings: dict[str, Any] = FLEXIBLE | INTEGRATOR[options.get("trusses", "rigid")]
    return mbd.simulate(
        system, DURATION, steps=steps, phases=phases(), designs={ANGLES: angles}, gradients="none", **settings
    )


def hinges(motion: mbd.Trajectory) -> dict[str, Tensor]:
    """Angles of both hinges [lanes, times] [rad]."""
    return {"panels 1 and 2": phi2(motion), "panels 2 and 3": phi3(motion)}


def phi2(motion: mbd.Trajectory) -> Tensor:
    """Angle of panel 2 from panel 1 about Y [lanes, times] [rad]."""
    return turned(motion.body("panel2").A.mT)


def driven(motion: mbd.Trajectory) -> Tensor:
    """Angle of the rocker from panel 1 about Y [lanes, times] [rad]; that of panel 2 if all is rigid."""
    return turned(motion.body("rocker").A.mT)


def phases() -> list[mbd.Phase]:
    """Phase 1, phase 2, and what follows."""
    first, second = (mbd.Event(lambda motion, s=s: s(motion) - LATCH, "falling") for s in (theta, driven))
    inner, outer = ["R3", "S5", "S6"], ["R1", "R2", "S9", "S10"]
    free, held, ends = ["S7", "S8"], ["D", "E"], ["S11", "S12"]
    pull = {"B": Table(PULL, DAMPING, MIDDLE)}
    return [
        mbd.Phase(until=first, release=["L7", "L8", "L11", "L12"], name="1"),
        mbd.Phase(lasting=REST, lock=inner, release=[*free, "L11", "L12"], name="rest"),
        mbd.Phase(until=second, lock=inner, release=[*free, *held, "L11", "L12"], laws=pull, name="2"),
        mbd.Phase(lock=[*inner, *outer], release=[*free, *held, *ends], name="3"),
    ]
