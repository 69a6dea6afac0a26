"""The slider-crank with a laminated connecting rod: section 5 of the paper.

The paper prints the ply, the section and the crank speed. Lengths, end time, start and attachments are not printed;
they were inferred by fitting the paper's own Tables 2-4. `LABELS` says which is which:
given (printed), inferred (fits the printed numbers), chosen (free, no effect seen).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchmbd.errors import InputError, unknown
from torchmbd.fem import mesh
from torchmbd.fem.materials import Laminate, Ply, Strength
from torchmbd.math.angles import deg
from torchmbd.multibody.bodies import FlexibleBody, Ground, RigidBody
from torchmbd.multibody.joints import Drive, Prismatic, Revolute, Spherical, Universal
from torchmbd.multibody.system import System

CARBON: dict[str, Any] = {
    "E1": 128e9,
    "E2": 10.1e9,
    "G12": 5.36e9,
    "G13": 5.36e9,
    "G23": 5.36e9,
    "nu12": 0.23,
    "density": 1586.0,
}
THICKNESS, DEPTH, SPEED = 0.0075, 0.04, 124.8
CRANK, ROD, SLIDER_MASS, DURATION = 0.152, 0.304, 0.0723, 0.06
#: The joint of rod and slider. Both let the rod's end bend and twist; "spherical" leaves the spin of the whole rod free, too.
JOINTS = ("universal", "spherical")
LABELS = {
    "ply": "given",
    "thickness": "given",
    "depth": "given",
    "speed": "given",
    "crank": "inferred",
    "rod": "inferred",
    "duration": "inferred",
    "joint": "chosen",
    "slider_mass": "chosen",
    "crank_mass": "chosen",
    "cells": "chosen",
    "modes": "chosen",
}


def build(
    layers: int = 3,
    angles: Sequence[float] | None = None,
    cells: tuple[int, int] = (24, 4),
    modes: int = 8,
    damping: float = 0.0,
    reduction: str = "vibration",
    interface: Sequence[str | int] = (),
    updated: bool = True,
    kind: str = "quad",
    joint: str = "universal",
    strength: Strength | None = None,
) -> System:
    """Slider-crank with a rod of equal layers.

    layers   number of layers of equal thickness, 7.5 mm in all
    angles   ply angles [deg], bottom to top; default: the start design of Table 2, alternating 45 and -45
    cells    cells of the rod's mesh along its length and depth
    kind     "quad", or "triangle", two in each cell
    modes    retained modes of the rod
    damping  stiffness-proportional damping of the rod [s]
    reduction, interface, updated   of the rod, as in FlexibleBody.plate
    joint    of rod and slider: "universal", which keeps the rod from spinning about itself, or "spherical", as in the
             independent codes (experiments/peers/exudyn_peer.py). If bending and twist are coupled, the two joints give
             different motions: at 17 degrees the peak of U is 0.103 and 0.094 J
    strength of the plies
    """
    if joint not in JOINTS:
        raise unknown("joint", joint, JOINTS)
    plies = [45.0 if i % 2 == 0 else -45.0 for i in range(layers)] if angles is None else list(angles)
    if len(plies) != layers:
        raise InputError(
            "angles", angles, f"must have {layers}, one for each of layers={layers}", state=f"has {len(plies)} entries"
        )
    laminate = Laminate(Ply(**CARBON, strength=strength), deg(plies), THICKNESS / layers)
    plate = mesh.rectangle(length=ROD, width=DEPTH, cells=(cells[0], cells[1]), kind=kind)
    # The normal of the plate lies in the plane of motion, so that the 7.5 mm side bends (inferred).
    axes = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    rod = FlexibleBody.plate(
        "rod",
        plate,
        laminate,
        modes=modes,
        position=(CRANK + ROD / 2, 0, 0),
        axes=axes,
        damping=damping,
        reduction=reduction,
        interface=interface,
        updated=updated,
    )
    crank = RigidBody("crank", mass=0.1, inertia=(1e-4, 1e-4, 1e-4))
    slider = RigidBody("slider", mass=SLIDER_MASS, inertia=(1e-4, 1e-4, 1e-4), position=(CRANK + ROD, 0, 0))
    ground, pin, eye = Ground(), rod.at("right"), slider.at(0, 0, 0)
    return System(
        bodies=[crank, rod, slider],
        joints=[
            Revolute(ground.at(0, 0, 0), crank.at(0, 0, 0), axis="z"),
            Drive(ground, crank, axis="z", speed=SPEED),
            Spherical(crank.at(CRANK, 0, 0), rod.at("left")),
            # The arm along the depth is the axis in which the rod swings; the other keeps it from spinning.
            Universal(pin, eye, axes="yz") if joint == "universal" else Spherical(pin, eye),
            Prismatic(ground.at(0, 0, 0), slider.at(0, 0, 0), axis="x"),
        ],
    )
