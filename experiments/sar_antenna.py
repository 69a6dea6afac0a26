"""Half of the SAR antenna of ERS-1, first phase of its deployment: section 6 of the paper. `python -m experiments.sar_antenna`

    panel 1 (ground) = panel 2 = panel 3      hinges of two spherical joints each; X deployment, Y width, Z front normal
    crank at the middle of panel 2, two rods from its tip to panel 3: a parallelogram, driven by actuator A

theta    angle of the crank from panel 2 about Y [rad]: 3.12 stowed, 0 in line (a dead point)
phi2     angle of panel 2 from panel 1, held by D and E at its outer corners, across its plane [rad]
M        torque of actuator A on panel 2, -M on the crank; eq. (39) [N m]

The paper prints counts, panels, material, lay-ups, eq. (39) and results. Joint positions, sizes of trusses and attachments
are a stand-in whose hub and rod points were picked after seeing two of the paper's numbers: a calibration, not a reproduction.
`LABELS` says which is which: given (printed), inferred, chosen. The reference values beside which the commands print ours
are those of an independent code with these data (experiments/sar_antenna_tables.py).
Checked in tests/experiments/test_sar_antenna.py.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from torchmbd.forces import Pieces, Table

IM6: dict[str, Any] = {
    "E1": 177e9,
    "E2": 10.8e9,
    "G12": 7.6e9,
    "G13": 7.6e9,
    "G23": 8.504e9,
    "nu12": 0.27,
    "density": 1600.0,
}
LENGTH, WIDTH, PLY = 1.994, 1.300, 0.5e-3
STOWED, DAMPING, DURATION = 3.12, 0.5, 3.0
MIDDLE = math.pi / 2  # of the range in which angles are told
HALF, HUB = LENGTH / 2, 0.0
ROD_POINT = (0.74775, 0.4875)
CRANK = HALF + ROD_POINT[0]  # parallel to panel 3
ROD = HALF - HUB
KNOTS = ((-0.2, -2.00), (0.2, 2.00), (2.63, 2.00), (3.02, 4.03), (3.08, 0.45), (3.12, 0.10))
LABELS = {
    "material": "given",
    "panels": "given",
    "lay-ups": "given",
    "counts of bodies and joints": "given",
    "eq. (39), damping": "given",
    "duration": "given",
    "knots of the continuous law": "inferred",
    "arrangement of the joints": "inferred",
    "hub, rod point": "chosen, after seeing the paper's two integrals",
    "trusses": "chosen",
    "attachments": "chosen",
    "cells, modes": "chosen",
}


def continuous_law(strength: float = 1.0) -> Table:
    """Eq. (39) through its knots, without the jumps of the printed pieces: torque on the crank about Y [N m]."""
    return Table(tuple((s, -strength * M) for s, M in KNOTS), damping=DAMPING, center=MIDDLE)


def printed_law(strength: float = 1.0, width: float = 2e-3) -> Pieces:
    """Eq. (39) as printed; its jumps at the borders are spread over +-width [rad]."""
    M = [(-2.0, 0.0), (0.0, 10.0), (2.0, 0.0), (4.03 - 5.19 * 3.02, 5.19), (0.45 + 60.41 * 3.08, -60.41)]
    M.append((0.10 + 9.00 * 3.12, -9.00))
    borders = (-0.2, 0.2, 2.63, 3.02, 3.08)
    return Pieces(
        borders, tuple(-strength * a for a, _ in M), tuple(-strength * k for _, k in M), width, DAMPING, MIDDLE
    )


ROD_JOINTS = {
    "spherical": lambda a, b, name: mbd.Spherical(a, b, name=name),
    "universal": lambda a, b, name: mbd.Universal(a, b, axes="yz", name=name),
}
LAWS = {"continuous": continuous_law, "printed": printed_law}


@dataclass(frozen=True)
class Truss:
    """Solid circular trusses of one ply, fibers along the axis.

    kind    "rigid" or "beam"
    radius  [m]
    modes   of a beam
    """

    kind: str = "rigid"
    radius: float = 5e-3
    modes: int = 4

    def between(self, name: str, start: Tensor, end: Tensor, clamped: bool = False) -> tuple[Any, mbd.Frame, mbd.Frame]:
        """A truss between two points in ground axes, and the frames at its ends; `clamped`: frame at the start, not amid."""
        length = float((end - start).norm())
        x = (end - start) / length
        z = torch.linalg.cross(x, torch.tensor([0.0, 1.0, 0.0], dtype=x.dtype))
        z = z / z.norm()
        axes = torch.stack([x, torch.linalg.cross(z, x), z], 1)
        area = math.pi * self.radius**2
        if self.kind == "rigid":
            mass, spin = IM6["density"] * area * length, self.radius**2 / 2
            across = mass * (length**2 / 12 + spin / 2)
            inertia, center = (mass * spin, across, across), (length / 2, 0.0, 0.0)
            rigid = mbd.RigidBody(name, mass, inertia, center, position=start, axes=axes)
            return rigid, rigid.at(), rigid.at(length)
        second = math.pi * self.radius**4 / 4
        E, G, shear, rho = IM6["E1"], IM6["G12"], 6.0 / 7.0, IM6["density"]
        stiffness = [E * area, shear * G * area, shear * G * area, 2 * G * second, E * second, E * second]
        inertia = [rho * area] * 3 + [2 * rho * second, rho * second, rho * second]
        section = mbd.GivenSection(*(torch.diag(torch.tensor(x, dtype=torch.float64)) for x in (stiffness, inertia)))
        where = {"reference": "start" if clamped else "center", "position": start if clamped else (start + end) / 2}
        line = mbd.BeamLine.straight(length, 16)
        beam = mbd.FlexibleBody.beam(name, line, section, self.modes, axes=axes, **where)
        return beam, beam.at("start"), beam.at("end")


def folded(angle: float) -> Tensor:
    """Axes of a panel that is turned by an angle from X towards Z."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)


@dataclass(frozen=True)
class Panel:
    """A panel: its body, and frames on it by their places in the plane of its joints.

    arm   from the plane of the joints to the mid-surface along the normal [m]
    """

    body: Any
    arm: float

    def at(self, x: float, y: float) -> mbd.Frame:
        """Frame at a place from the center [m]; on a flexible panel that of a mesh node."""
        if isinstance(self.body, mbd.RigidBody):
            return self.body.at(x, y, -self.arm)
        place = torch.tensor([x, y, 0.0], dtype=torch.float64)
        distance = (self.body.mesh.nodes - place).norm(dim=1)
        if float(distance.min()) > 1e-9:
            raise mbd.InputError(
                f"no node at ({x}, {y}) m of {self.body.name!r}; allowed: cells in multiples of (16, 8)"
            )
        return self.body.at(int(distance.argmin()), offset=(0.0, 0.0, -self.arm))


def rigid_panel(name: str, **where: Any) -> mbd.RigidBody:
    """A rigid panel of the mass of the laminate."""
    h = 4 * PLY
    m = IM6["density"] * LENGTH * WIDTH * h
    inertia = (m * (WIDTH**2 + h**2) / 12, m * (LENGTH**2 + h**2) / 12, m * (LENGTH**2 + WIDTH**2) / 12)
    return mbd.RigidBody(name, m, inertia, **where)


def laminate(angles: Sequence[float]) -> mbd.Laminate:
    """Symmetric laminate of four layers; `angles` [deg] are those of the lower two."""
    return mbd.Laminate(mbd.Ply(**IM6), mbd.deg(list(angles)), PLY, symmetric=True)


def build(
    angles: Sequence[float] | None = (55.0, -55.0),
    angles3: Sequence[float] | None = None,
    modes: int = 12,
    cells: tuple[int, int] = (16, 8),
    law: str = "continuous",
    trusses: str = "rigid",
    rods: str = "spherical",
    radius: float = 5e-3,
    arm: float = 0.0,
    strength: float = 1.0,
    mass: str = "lumped",
) -> mbd.System:
    """The antenna in the first phase.

    angles    theta1, theta2 of theta1/theta2/theta2/theta1 [deg], of both panels; None: rigid panels
    angles3   of panel 3 alone, if it has a laminate of its own
    modes     retained modes of a panel
    cells     cells of a panel's mesh, multiples of (16, 8)
    law       "continuous", or "printed" with its jumps spread over 2e-3 rad
    trusses   "rigid" or "beam"
    rods      their joints at the crank: "spherical", as printed, or "universal": they cannot spin
    radius    of the trusses [m]
    arm       of all joints from the mid-surfaces of the panels [m]
    strength  factor of the actuator's law
    mass      of the panels: "lumped", as in the paper, or "consistent"
    """
    for name, given, allowed in (
        ("law", law, LAWS),
        ("rods", rods, ROD_JOINTS),
        ("trusses", trusses, ("rigid", "beam")),
    ):
        if given not in allowed:
            raise mbd.InputError(f"{name} is {given!r}; allowed: {', '.join(allowed)}")
    ground, truss = mbd.Ground(), Truss(trusses, radius)
    flat, up = folded(STOWED), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    hinge = LENGTH * flat[:, 0]
    center2, center3 = HALF * flat[:, 0], hinge + torch.tensor([HALF, 0.0, 0.0], dtype=torch.float64)
    places = {"position": center2 + arm * flat[:, 2], "axes": flat}, {"position": center3 + arm * up}
    panel2, panel3 = (Panel(body, arm) for body in _panels(angles, angles3, places, modes, cells, mass))
    hub = center2 + HUB * flat[:, 0]
    tip = hub + torch.tensor([CRANK, 0.0, 0.0], dtype=torch.float64)
    crank, crank_hub, crank_tip = truss.between("crank", hub, tip, clamped=True)
    x, y = ROD_POINT
    ends = [center3 + torch.tensor([x, side * y, 0.0], dtype=torch.float64) for side in (-1, 1)]
    made = [truss.between(f"rod{side}", tip, end) for side, end in zip("ab", ends, strict=True)]
    joints = _hinges(ground, panel2, panel3)
    for k, (y_rod, (_, start, end)) in enumerate(zip((-y, y), made, strict=True), 1):
        joints.append(ROD_JOINTS[rods](crank_tip, start, f"S{k + 4}"))
        joints.append(mbd.Spherical(end, panel3.at(x, y_rod), name=f"S{k + 6}"))
    joints.append(mbd.Revolute(panel2.at(HUB, 0.0), crank_hub, axis="y", name="R3"))
    actuator = mbd.RotationalSpringDamper(panel2.at(HUB, 0.0), crank_hub, axis="y", law=LAWS[law](strength), name="A")
    return mbd.System([panel2.body, panel3.body, crank, *(rod for rod, _, _ in made)], joints, [actuator])


def _hinges(ground: mbd.Ground, panel2: Panel, panel3: Panel) -> list[Any]:
    """Both hinge lines, and what holds the outer corners of panel 2 across its plane."""
    flat = folded(STOWED)
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


def _panels(
    angles: Sequence[float] | None,
    angles3: Sequence[float] | None,
    places: tuple[dict[str, Any], dict[str, Any]],
    modes: int,
    cells: tuple[int, int],
    mass: str,
) -> list[Any]:
    if angles is None:
        return [rigid_panel(name, **place) for name, place in zip(("panel2", "panel3"), places, strict=True)]
    mesh = mbd.mesh.rectangle(LENGTH, WIDTH, (cells[0], cells[1]))
    stack = laminate(angles)
    # Panel 2: a bonded axle over the full width; a clamp at a point does not converge with the mesh.
    axle = torch.nonzero(mesh.nodes[:, 0].abs() < 1e-9)[:, 0].tolist()
    given = ("panel2", stack, axle), ("panel3", stack if angles3 is None else laminate(angles3), "center")
    return [
        mbd.FlexibleBody.plate(name, mesh, own, modes, reference=reference, mass=mass, **place)
        for (name, own, reference), place in zip(given, places, strict=True)
    ]


def theta(motion: mbd.Trajectory) -> Tensor:
    """Angle of the crank from panel 2 about Y [lanes, times] [rad]."""
    return _turned(motion, "panel2", "crank")


def phi3(motion: mbd.Trajectory) -> Tensor:
    """Angle of panel 3 from panel 2 about Y [lanes, times] [rad]; that of the crank if all is rigid."""
    return _turned(motion, "panel2", "panel3")


def _turned(motion: mbd.Trajectory, a: str, b: str) -> Tensor:
    A = motion.body(a).A.mT @ motion.body(b).A
    turn = torch.complex(A[..., 0, 0], -A[..., 2, 0])
    return torch.angle(turn * cmath.exp(-1j * MIDDLE)) + MIDDLE


if __name__ == "__main__":
    from experiments.sar_antenna_tables import main  # the commands import this model

    main()
