"""The whole half of the antenna: 12 bodies, 16 spherical and 3 revolute joints, three planar loops, rigid.

    loop 3   panel 2, panel 3, crank at R3, two rods                        phase 1 (experiments/sar_antenna.py)
    loop 2   panel 1, panel 2, rocker at R2, two rods                       like loop 3
    loop 1   panel 1, rocker, driver at R1, two rods                        phase 2, by actuator B at R1

    freedoms by count 6 * 11 - (16 * 3 + 3 * 5) = 3; five rows depend on others: rank 58, mobility 8 = 2 + 6 spins of rods

The counts are given; places of the second and first loop are chosen: joints in the mid-surfaces, R2 at the center of panel
1, a driver that swings above panel 1.
Checked in tests/experiments/test_sar_antenna.py.
"""

from __future__ import annotations

from typing import Any

import torch

import torchmbd as mbd
from experiments.sar_antenna import build
from experiments.sar_antenna_bodies import Truss, folded
from experiments.sar_antenna_data import CRANK, HALF, ROD_POINT, STOWED

DRIVER_AT, DRIVER, HANDLE = -1.8, 0.5, 0.2  # X of R1, length of the driver, half width of its handle [m]; chosen


def whole() -> mbd.System:
    """The stowed antenna with nothing held; panels and trusses rigid."""
    first, ground, truss = build(None), mbd.Ground(), Truss()
    panel2 = first.body("panel2")
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
        there = panel2.at(ROD_POINT[0], y, 0.0)
        rod, start, end = truss.between(f"rod2{'ab'[k]}", tip, panel2.position + flat @ there.point)
        joints += [
            mbd.Spherical(rocker_tip, start, name=f"S{9 + k}"),
            mbd.Spherical(end, there, name=f"S{11 + k}"),
        ]
        handle = torch.tensor([0.0, side * HANDLE, 0.0], dtype=torch.float64)
        link, start, end = truss.between(f"rod1{'ab'[k]}", grip + handle, elbow)
        joints += [
            mbd.Spherical(driver.at(DRIVER, side * HANDLE, 0.0), start, name=f"S{13 + k}"),
            mbd.Spherical(end, rocker.at(DRIVER), name=f"S{15 + k}"),
        ]
        bodies += [rod, link]
    free = [joint for joint in first.joints if joint.name not in ("D", "E")]
    return mbd.System([*first.bodies, *bodies], [*free, *joints], first.forces)
