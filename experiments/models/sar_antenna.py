"""Half of the SAR antenna of ERS-1, first phase of its deployment: section 6 of the paper.

    panel 1 (ground) = panel 2 = panel 3      hinges of two spherical joints each; X deployment, Y width, Z front normal
    crank at the middle of panel 2, two rods from its tip to panel 3: a parallelogram, driven by actuator A

theta    angle of the crank from panel 2 about Y [rad]: 3.12 stowed, 0 in line (a dead point)
phi2     angle of panel 2 from panel 1, held by D and E at its outer corners, across its plane [rad]
M        torque of actuator A on panel 2, -M on the crank; eq. (39) [N m]

The paper prints counts, panels, material, lay-ups, eq. (39) and results. Joint positions, sizes of trusses and attachments
are a stand-in whose hub and rod points were picked after seeing two of the paper's numbers: a calibration, not a reproduction.
`LABELS` (sar_antenna_data.py) says which is which: given (printed), inferred, chosen. experiments/paper/antenna_tables.py
prints results beside the paper's and those of an independent code with these data.
Checked in tests/experiments/test_sar_antenna.py.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.models.sar_antenna_bodies import Panel, Truss, folded, panels
from experiments.models.sar_antenna_data import HALF, LAWS, LENGTH, MIDDLE, ROD_POINT, SHARP, STOWED, WIDTH

ROD_JOINTS = {
    "spherical": lambda a, b, name: mbd.Spherical(a, b, name=name),
    "universal": lambda a, b, name: mbd.Universal(a, b, axes="yz", name=name),
}


def build(
    angles: Sequence[float] | None = (55.0, -55.0),
    angles3: Sequence[float] | None = None,
    modes: int = 14,
    cells: tuple[int, int] = (32, 16),
    law: str = "continuous",
    trusses: str = "rigid",
    rods: str = "spherical",
    radius: float = 5e-3,
    arm: float = 0.0,
    strength: float = 1.0,
    mass: str = "lumped",
    reduction: str = "vibration",
    truss_angles: Sequence[float] = (0.0, 0.0),
    hub: float = 0.0,
    rod_point: Sequence[float] = ROD_POINT,
    stowed: float = STOWED,
) -> mbd.System:
    """The antenna in the first phase.

    angles    theta1, theta2 of theta1/theta2/theta2/theta1 [deg], of both panels, or all four; None: rigid panels
    angles3   of panel 3 alone, if it has a laminate of its own
    modes     retained modes of a panel
    reduction "vibration", as in the paper, or "craig-bampton": statics of the panels under the forces of their joints are
              exact, and four to eight modes are enough
    cells     cells of a panel's mesh, multiples of (16, 8)
    law       "continuous", or "printed" with its jumps spread over 2e-3 rad, or "sharp": these located by `jumps`
    trusses   "rigid", "beam" or "tube"
    rods      their joints at the crank: "spherical", as printed, or "universal": they cannot spin
    radius    of the trusses [m]
    arm       of all joints from the mid-surfaces of the panels [m]
    strength  factor of the actuator's law
    mass      of the panels: "lumped", as in the paper, or "consistent"
    truss_angles  of the plies of tubes, design parameters [deg]
    hub       half the width of the strip of panel 2 that is bonded to the axle, from 0, its nodes on one line [m]
    rod_point where the rods end on panel 3, x and +-y from its center: a place of the mesh [m]
    stowed    angle of panel 2 from panel 1 [rad]
    """
    for name, choice, allowed in (
        ("law", law, LAWS),
        ("rods", rods, ROD_JOINTS),
        ("trusses", trusses, ("rigid", "beam", "tube")),
        ("reduction", reduction, ("vibration", "craig-bampton")),
    ):
        if choice not in allowed:
            raise mbd.InputError(name, choice, allowed)
    ground, truss, (x, y) = mbd.Ground(), Truss(trusses, radius, tuple(truss_angles)), rod_point
    flat, level = folded(stowed), folded(stowed - STOWED)  # axes of panel 2, of panel 3 and its parallel, the crank
    center2, center3 = HALF * flat[:, 0], LENGTH * flat[:, 0] + HALF * level[:, 0]
    places = [{"position": x + arm * A[:, 2], "axes": A} for x, A in ((center2, flat), (center3, level))]
    bodies = panels(angles, angles3, places, modes, cells, mass, reduction, hub, (x, y))
    panel2, panel3 = (Panel(body, arm) for body in bodies)
    tip = center2 + (HALF + x) * level[:, 0]
    crank, crank_hub, crank_tip = truss.between("crank", center2, tip, clamped=True)
    ends = [center3 + level @ torch.tensor([x, side * y, 0.0], dtype=torch.float64) for side in (-1, 1)]
    links = [truss.between(f"rod{side}", tip, end) for side, end in zip("ab", ends, strict=True)]
    joints = _hinges(ground, panel2, panel3, flat)
    for k, (y_rod, (_, start, end)) in enumerate(zip((-y, y), links, strict=True), 1):
        joints.append(ROD_JOINTS[rods](crank_tip, start, f"S{k + 4}"))
        joints.append(mbd.Spherical(end, panel3.at(x, y_rod), name=f"S{k + 6}"))
    joints.append(mbd.Revolute(panel2.at(0.0, 0.0), crank_hub, axis="y", name="R3"))
    actuator = mbd.RotationalSpringDamper(panel2.at(0.0, 0.0), crank_hub, axis="y", law=LAWS[law](strength), name="A")
    return mbd.System([panel2.body, panel3.body, crank, *(rod for rod, _, _ in links)], joints, [actuator])


def _hinges(ground: mbd.Ground, panel2: Panel, panel3: Panel, flat: Tensor) -> list[Any]:
    """Both hinge lines, and what holds the outer corners of panel 2 across its plane of the axes `flat`."""
    outer = LENGTH * flat[:, 0]
    joints: list[Any] = []
    for side, k in ((-1, 1), (1, 2)):
        edge = side * WIDTH / 2
        corner = ground.at(float(outer[0]), edge, float(outer[2]), axes=flat)
        joints += [
            mbd.Spherical(ground.at(0, edge, 0), panel2.at(-HALF, edge), name=f"S{k}"),
            mbd.Spherical(panel2.at(HALF, edge), panel3.at(-HALF, edge), name=f"S{k + 2}"),
            mbd.PointOnPlane(corner, panel2.at(HALF, edge), normal="z", name="DE"[k - 1]),
        ]
    return joints


def jumps(borders: Sequence[float] = (3.08,)) -> list[mbd.Phase]:
    """Phases that end where the printed law is about to jump, so that no step has a jump amid; for the law "sharp".

    borders   theta of the jumps that the motion passes, falling [rad]
    """
    ends = [mbd.Event(lambda motion, s=s: theta(motion) - (s + 30.0 * SHARP), "falling") for s in borders]
    return [*(mbd.Phase(until=end) for end in ends), mbd.Phase()]


def theta(motion: mbd.Trajectory) -> Tensor:
    """Angle of the crank from panel 2 about Y [lanes, times] [rad]."""
    return _turned(motion, "panel2", "crank")


def phi3(motion: mbd.Trajectory) -> Tensor:
    """Angle of panel 3 from panel 2 about Y [lanes, times] [rad]; that of the crank if all is rigid."""
    return _turned(motion, "panel2", "panel3")


def _turned(motion: mbd.Trajectory, a: str, b: str) -> Tensor:
    return turned(motion.body(a).A.mT @ motion.body(b).A)


def turned(A: Tensor) -> Tensor:
    """Angle [...] about Y of a rotation [..., 3, 3], from -pi/2 to 3 pi/2 [rad]."""
    turn = torch.complex(A[..., 0, 0], -A[..., 2, 0])
    return torch.angle(turn * cmath.exp(-1j * MIDDLE)) + MIDDLE
