"""Bodies of the SAR antenna: laminated panels with frames at their joints, and trusses.

Checked in tests/experiments/test_sar_antenna.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.models.sar_antenna_data import HALF, IM6, LENGTH, PLY, WIDTH


@dataclass(frozen=True)
class Truss:
    """Trusses of one kind and one section.

    kind    "rigid" or "beam": solid circles, fibers along the axis; "tube": wound tubes of two plies of the same mass
    radius  of the circle [m]
    angles  of the plies of a tube from the axis, from inside to outside [deg]: design parameters that all tubes share
    modes   of a beam or a tube
    """

    kind: str = "rigid"
    radius: float = 5e-3
    angles: tuple[float, ...] = (0.0, 0.0)
    modes: int = 4

    @cached_property
    def section(self) -> mbd.sections.Section | mbd.GivenSection:
        """That of a flexible truss."""
        return self._tube() if self.kind == "tube" else self._circle()

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
        where = {"reference": "start" if clamped else "center", "position": start if clamped else (start + end) / 2}
        line = mbd.BeamLine.straight(length, 16)
        beam = mbd.FlexibleBody.beam(name, line, self.section, self.modes, axes=axes, **where)
        return beam, beam.at("start"), beam.at("end")

    def _circle(self) -> mbd.GivenSection:
        area, second = math.pi * self.radius**2, math.pi * self.radius**4 / 4
        E, G, shear, rho = IM6["E1"], IM6["G12"], 6.0 / 7.0, IM6["density"]
        stiffness = [E * area, shear * G * area, shear * G * area, 2 * G * second, E * second, E * second]
        inertia = [rho * area] * 3 + [2 * rho * second, rho * second, rho * second]
        return mbd.GivenSection(*(torch.diag(torch.tensor(x, dtype=torch.float64)) for x in (stiffness, inertia)))

    def _tube(self) -> mbd.sections.Section:
        wall = PLY * len(self.angles)
        middle = self.radius**2 / (2.0 * wall)
        return mbd.sections.tube(middle + wall / 2.0, mbd.Ply(**IM6), mbd.deg(list(self.angles)), PLY, cells=(24, 1))


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
        return self.body.at(node_at(self.body.mesh, self.body.name, x, y), offset=(0.0, 0.0, -self.arm))


def rigid_panel(name: str, **where: Any) -> mbd.RigidBody:
    """A rigid panel of the mass of the laminate."""
    h = 4 * PLY
    m = IM6["density"] * LENGTH * WIDTH * h
    inertia = (m * (WIDTH**2 + h**2) / 12, m * (LENGTH**2 + h**2) / 12, m * (LENGTH**2 + WIDTH**2) / 12)
    return mbd.RigidBody(name, m, inertia, **where)


def laminate(angles: Sequence[float]) -> mbd.Laminate:
    """Laminate of four layers; `angles` [deg] of the lower two, if it is symmetric, or of all four."""
    return mbd.Laminate(mbd.Ply(**IM6), mbd.deg(list(angles)), PLY, symmetric=len(angles) == 2)


# Corners of a panel, in the plane of the mesh.
CORNERS = tuple((side * HALF, across * WIDTH / 2) for side in (-1, 1) for across in (-1, 1))


def panels(
    angles: Sequence[float] | None,
    angles3: Sequence[float] | None,
    places: Sequence[dict[str, Any]],
    modes: int,
    cells: tuple[int, int],
    mass: str,
    reduction: str,
    hub: float,
    rod_point: tuple[float, float],
) -> list[Any]:
    """Panels 2 and 3; the arguments are those of experiments.models.sar_antenna.build."""
    if angles is None:
        return [rigid_panel(name, **place) for name, place in zip(("panel2", "panel3"), places, strict=True)]
    mesh = mbd.mesh.rectangle(LENGTH, WIDTH, (cells[0], cells[1]))
    stack = laminate(angles)
    # Panel 2: a bonded axle over the full width; a clamp at a point does not converge with the mesh.
    axle = torch.nonzero(mesh.nodes[:, 0].abs() < hub + 1e-9)[:, 0].tolist()
    ends = [(rod_point[0], side * rod_point[1]) for side in (-1, 1)]
    other = stack if angles3 is None else laminate(angles3)
    plates = ("panel2", stack, axle, CORNERS), ("panel3", other, "center", (*CORNERS[:2], *ends))
    bodies = []
    for (name, layup, reference, joints), place in zip(plates, places, strict=True):
        kept = [node_at(mesh, name, *joint) for joint in joints] if reduction == "craig-bampton" else ()
        options = {"reference": reference, "mass": mass, "reduction": reduction, "interface": kept}
        bodies.append(mbd.FlexibleBody.plate(name, mesh, layup, modes, **options, **place))
    return bodies


def node_at(mesh: mbd.Mesh, name: str, x: float, y: float) -> int:
    """Node at a place of the mesh of a panel [m]; InputError if there is none."""
    distance = (mesh.nodes - torch.tensor([x, y, 0.0], dtype=torch.float64)).norm(dim=1)
    if float(distance.min()) > 1e-9:
        raise mbd.InputError(
            "cells", hint="cells in multiples of (16, 8)", state=f"of {name!r} have no node at ({x}, {y}) m"
        )
    return int(distance.argmin())
