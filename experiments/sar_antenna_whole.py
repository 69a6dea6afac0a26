"""The whole half of the antenna: 12 bodies, 16 spherical and 3 revolute joints, three planar loops, both phases.

    loop 3   panel 2, panel 3, crank at R3, two rods                        phase 1, actuator A (experiments/sar_antenna.py)
    loop 2   panel 1, panel 2, rocker at R2, two rods                       like loop 3
    loop 1   panel 1, rocker, driver at R1, two rods                        phase 2, actuator B at R1

    freedoms by count 6 * 11 - (16 * 3 + 3 * 5) = 3; five rows depend on others: rank 58, mobility 8 = 2 + 6 spins of rods

    phase 1    D and E hold panel 2; A unfolds panel 3 until it is `LATCH` before the line of panel 2
    phase 2    A is locked, D and E are released; B swings both panels out until panel 2 is `LATCH` before the line of panel 1
    phase 3    B is locked

phi2, phi3   angle of panel 2 from panel 1, of panel 3 from panel 2, about Y [rad]: 3.12 stowed, 0 in line

In line is a dead point: rigid rods lock there. So a latch takes each hinge over: a stop damps the end of its way, and
at `LATCH` the rods leave the panel and are locked with their crank, and a spring draws the hinge into line.
The counts are given; places of the second and first loop, actuator B and the latches are chosen: joints in the mid-surfaces,
R2 at the center of panel 1, a driver that swings above panel 1, B like A and stronger, for it moves both panels.
Checked in tests/experiments/test_sar_antenna_whole.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.sar_antenna import build, phi3, turned
from experiments.sar_antenna_bodies import Panel, Truss, folded
from experiments.sar_antenna_data import CRANK, HALF, MIDDLE, ROD_POINT, STOWED
from torchmbd.forces import Gap, Table

DRIVER_AT, DRIVER, HANDLE = -1.8, 0.5, 0.2  # X of R1, length of the driver, half width of its handle [m]
PULL, DAMPING = 22.0, 25.0  # torque of actuator B [N m], its damping [N m s]
SECOND, RAMP = 10.0, 0.5  # when B begins to pull, and how long it takes to its full torque [s]
LATCH = 0.1  # [rad]
# Stops at R1 and at the hinges 1-2 and 2-3: the end of the way that they damp [rad], and how much [N m s].
STOPS = {"B": (1.2, 110.0), "H2": (0.2, 200.0), "H3": (1.0, 22.0)}
SPRINGS = {"H2": 30.0, "H3": 5.0}  # largest torque of the latches [N m]
DURATION = 20.0  # of both phases, as in Figs. 24, 25 [s]


@dataclass(frozen=True)
class Pull:
    """Torque of actuator B on the ground seen from the driver, which turns from 3.12 to 0: from `SECOND` on, -PULL."""

    center: float = MIDDLE

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        share = torch.clamp((t - SECOND) / RAMP, 0.0, 1.0)
        return -share * PULL * torch.clamp(s / STOPS["B"][0], -1.0, 1.0) - DAMPING * rate


def whole(angles: Sequence[float] | None = None, **options: Any) -> mbd.System:
    """The stowed antenna with D and E; trusses rigid; `angles`, `options`: of experiments.sar_antenna.build."""
    first, ground, truss = build(angles, **options), mbd.Ground(), Truss()
    panel2, panel3 = (Panel(first.body(name), 0.0) for name in ("panel2", "panel3"))
    flat = folded(STOWED)
    hub, base = torch.tensor([-HALF, 0.0, 0.0], dtype=torch.float64), torch.tensor([DRIVER_AT, 0, 0]).double()
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
        ]
        handle = torch.tensor([0.0, side * HANDLE, 0.0], dtype=torch.float64)
        link, start, end = truss.between(f"rod1{'ab'[k]}", grip + handle, elbow)
        joints += [
            mbd.Spherical(driver.at(DRIVER, side * HANDLE, 0.0), start, name=f"S{13 + k}"),
            mbd.Spherical(end, rocker.at(DRIVER), name=f"S{15 + k}"),
        ]
        bodies += [rod, link]
    foot = ground.at(*base.tolist())
    actuator = mbd.RotationalSpringDamper(driver_hub, foot, axis="y", law=Pull(), name="B")
    ends = edge(panel2, -1), edge(panel2, 1), edge(panel3, -1)
    hinges = {"H2": (ends[0], ground.at(0, 0, 0)), "H3": (ends[1], ends[2])}
    stops = [stop(name, *frames) for name, frames in ({"B": (driver_hub, foot)} | hinges).items()]
    springs = [spring(name, *frames) for name, frames in hinges.items()]
    forces = [*first.forces, actuator, *stops, *springs]
    return mbd.System([*first.bodies, *bodies], [*first.joints, *joints], forces)


def unlocked() -> mbd.System:
    """The rigid antenna without D and E: the joints that the paper counts."""
    system = whole()
    return system.with_joints([joint for joint in system.joints if joint.name not in ("D", "E")])


def edge(panel: Panel, side: int) -> mbd.Frame:
    """Frame on the middle of a hinge line of a panel, moving with the mean of its nodes."""
    if isinstance(panel.body, mbd.RigidBody):
        return panel.body.at(side * HALF, 0.0, 0.0)
    return panel.body.at("left_edge" if side < 0 else "right_edge")


def stop(name: str, a: mbd.Frame, b: mbd.Frame) -> mbd.RotationalSpringDamper:
    """What damps the end of a hinge's way; b turns from 3.12 to 0."""
    soft, damping = STOPS[name]
    law = Gap(0.0, soft, damping=damping, smooth=soft, center=MIDDLE)
    return mbd.RotationalSpringDamper(a, b, axis="y", law=law, name=f"{name}_stop")


def spring(name: str, a: mbd.Frame, b: mbd.Frame) -> mbd.RotationalSpringDamper:
    """What draws a hinge into line."""
    M = SPRINGS[name]
    knots = ((-2 * LATCH, 0.0), (-LATCH, M), (-LATCH / 5, M), (LATCH / 5, -M), (LATCH, -M), (2 * LATCH, 0.0))
    return mbd.RotationalSpringDamper(a, b, axis="y", law=Table(knots, center=MIDDLE), name=f"{name}_spring")


def phi2(motion: mbd.Trajectory) -> Tensor:
    """Angle of panel 2 from panel 1 about Y [lanes, times] [rad]."""
    return turned(motion.body("panel2").A.mT)


def phases() -> list[mbd.Phase]:
    """Phase 1, phase 2, and what follows."""
    crank, rocker = ["R3", "S5", "S6"], ["R1", "R2", "S9", "S10"]
    first = mbd.Event(lambda motion: phi3(motion) - LATCH, "falling")
    second = mbd.Event(lambda motion: phi2(motion) - LATCH, "falling")
    hinge, free = ["S3", "S4"], ["S7", "S8"]
    return [
        mbd.Phase(until=first, name="1"),
        mbd.Phase(until=mbd.Event(phi3, "rising"), lock=crank, release=free, name="rest"),
        mbd.Phase(until=second, lock=[*crank, *hinge], release=[*free, "D", "E"], name="2"),
        mbd.Phase(lock=[*crank, *hinge, *rocker], release=[*free, "D", "E", "S11", "S12"], name="3"),
    ]
