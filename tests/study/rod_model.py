"""A small slider-crank for the tests of the experiment layer: a model as a user would write it, outside the package."""

from __future__ import annotations

import torch

from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import rectangle
from torchmbd.integrate import Phase
from torchmbd.math.angles import deg
from torchmbd.multibody.bodies import FlexibleBody, Ground, RigidBody
from torchmbd.multibody.joints import Drive, Fixed, Prismatic, Revolute, Spherical, Universal
from torchmbd.multibody.system import System


def build(layers: int = 2, cells: int = 4, payload: float = 0.0) -> System:
    ply = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
    laminate = Laminate(ply, angles=deg([45.0, -45.0, 45.0][:layers]), thickness=7.5e-3 / layers)
    upright = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    mesh = rectangle(length=0.304, width=0.04, cells=(cells, 2))
    rod = FlexibleBody.plate("rod", mesh, laminate, modes=4, position=(0.304, 0, 0), axes=upright)
    crank = RigidBody("crank", 0.1, (1e-4, 1e-4, 1e-4))
    slider = RigidBody("slider", 0.0723, (1e-4, 1e-4, 1e-4), position=(0.456, 0, 0))
    ground = Ground()
    joints = [
        Revolute(ground.at(), crank.at(), axis="z"),
        Drive(ground, crank, axis="z", speed=124.8),
        Spherical(crank.at(0.152, 0, 0), rod.at("left")),
        Universal(rod.at("right"), slider.at(), axes="yz"),
        Prismatic(ground.at(), slider.at(), axis="x"),
    ]
    if not payload:
        return System([crank, rod, slider], joints)
    weight = RigidBody("weight", payload, (1e-4, 1e-4, 1e-4), position=(0.456, 0, 0.05))
    return System([crank, rod, slider, weight], [*joints, Fixed(slider.at(0, 0, 0.05), weight.at())])


def plain(motion):
    return motion.body("rod").strain_energy


def no_system() -> int:
    return 3


def broken() -> System:
    raise ZeroDivisionError("half a rod")


def in_two() -> list[Phase]:
    """Two phases of one and the same mechanism."""
    return [Phase(until=0.004), Phase()]


def too_long() -> list[Phase]:
    return [Phase(until=1.0), Phase()]


def no_phases() -> list[int]:
    return [1]


def broken_phases() -> list[Phase]:
    return [Phase(until=1 / 0)]
