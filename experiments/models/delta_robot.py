"""A delta robot with forearms of carbon tubes: three driven arms, six flexible rods, a plate that moves without turning.

Chosen, no publication: sizes of a small pick-and-place robot. Rods hang on a universal joint above and a spherical one below.
"""

from __future__ import annotations

import math

import torch

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
BASE, PLATE, ARM, ROD, HALF = 0.2, 0.06, 0.3, 0.7, 0.04  # radii, lengths, half the distance of two rods [m]
SWINGS = (0.35, -0.2, 0.1)  # of the arms [rad]


def build(angle: float = 20.0, frequency: float = 2.0) -> mbd.System:
    """Walls of the rods wound at +-angle [deg]; arms swing with the frequency [Hz]."""
    tube = mbd.sections.tube(0.008, CARBON, mbd.deg([angle, -angle]), thickness=0.5e-3, cells=(16, 1))
    line = mbd.BeamLine.straight(ROD, elements=6)
    low = -math.sqrt(ROD**2 - (BASE + ARM - PLATE) ** 2)
    plate = mbd.RigidBody("plate", 0.5, (1e-3, 1e-3, 2e-3), position=(0, 0, low))
    ground = mbd.Ground()
    bodies: list = [plate]
    joints: list = []
    for k in range(3):
        around = _about_z(2.0 * math.pi * k / 3.0)
        arm = mbd.RigidBody(f"arm{k}", 0.3, (1e-3, 3e-3, 3e-3), position=around @ _vector(BASE, 0, 0), axes=around)
        hinge = ground.at(*(around @ _vector(BASE, 0, 0)).tolist(), axes=around)
        law = mbd.Sine(amplitude=SWINGS[k], frequency=frequency)
        joints += [mbd.Revolute(hinge, arm.at(), axis="y"), mbd.Drive(hinge, arm.at(), axis="y", angle=law)]
        bodies.append(arm)
        for name, side in (("l", -HALF), ("r", HALF)):
            start, end = around @ _vector(BASE + ARM, side, 0), around @ _vector(PLATE, side, low)
            x = (end - start) / ROD
            y = around @ _vector(0, 1, 0)
            axes = torch.stack([x, y, torch.linalg.cross(x, y)], 1)
            rod = mbd.FlexibleBody.beam(f"rod{k}{name}", line, tube, modes=2, position=(start + end) / 2, axes=axes)
            upper, lower = arm.at(ARM, side, 0), plate.at(*(end - _vector(0, 0, low)).tolist())
            joints += [mbd.Universal(upper, rod.at("start"), axes="yz"), mbd.Spherical(rod.at("end"), lower)]
            bodies.append(rod)
    return mbd.System(bodies, joints, gravity=(0, 0, -9.81))


def _vector(x: float, y: float, z: float) -> torch.Tensor:
    return torch.tensor([x, y, z], dtype=torch.float64)


def _about_z(angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def motion() -> mbd.Trajectory:
    """One period of the swing."""
    return mbd.simulate(build(), 0.5, steps=500, gradients="none")
