"""Published motions of exact beams as systems: a right-angle cantilever, and a rod that flies in space.

J. C. Simo, L. Vu-Quoc, On the dynamics in space of rods undergoing large motions, Comput. Methods Appl. Mech. Eng. 66 (1988)
125-161. Data and curves read off its figures as AeroBeams.jl has them (elbowFrame, flyingSpaghetti3D).
"""

from __future__ import annotations

import torch
from torch import Tensor

import torchmbd as mbd
from tests.fem.exact_beam.cases import given, matrix

#: Out-of-plane displacements of the right-angle cantilever, read off: node, interval [s], largest value [m].
PEAKS = (("elbow", (0.0, 5.0), 5.5035), ("tip", (0.0, 10.0), 8.2947), ("tip", (12.0, 20.0), -9.6734))


def hat(t: Tensor, peak: float, rise: float) -> Tensor:
    """A load that grows and falls within `rise` [s] each."""
    return peak * ((t / rise).clamp(0.0, 1.0) - (t / rise - 1.0).clamp(0.0, 1.0))


def right_angle(elements: int) -> mbd.System:
    """Two legs of 10 m with so many elements each; 50 N across their plane at the elbow, 1 s up and 1 s down."""
    leg = torch.linspace(0.0, 10.0, elements + 1, dtype=torch.float64)[:, None]
    x, y = torch.eye(3, dtype=torch.float64)[:2]
    line = mbd.BeamLine(torch.cat([leg * x, 10.0 * x + leg[1:] * y]))
    section = given(1e6, 1e6, 1e6, 1e3, 1e3, 1e3, mass=matrix(1.0, 1.0, 1.0, 20.0, 10.0, 10.0))
    beam = mbd.FlexibleBeam("frame", line, section, orientation=(-1.0, 1.0, 0.0))
    wall = mbd.Fixed(mbd.Ground().at(), beam.at("start"), name="wall")
    push = mbd.Force(beam.at(elements), lambda t: torch.stack([0.0 * t, 0.0 * t, hat(t, 50.0, 1.0)]))
    return mbd.System([beam], [wall], [push])


def flying_rod(elements: int) -> mbd.System:
    """Free in space; a force along x, moments about y and z of 200 N m and half of it at one end, 2.5 s up and 2.5 s down."""
    section = given(1e4, 1e4, 1e4, 500.0, 500.0, 500.0, mass=matrix(1.0, 1.0, 1.0, 20.0, 10.0, 10.0))
    turn = [[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]]  # from (0, 0, 8) down to (6, 0, 0)
    rod = mbd.FlexibleBeam("rod", mbd.BeamLine.straight(10.0, elements), section, position=(0.0, 0.0, 8.0), axes=turn)
    push = mbd.Force(rod.at("end"), lambda t: flying_loads(t)[:3])
    twist = mbd.Torque(rod.at("end"), lambda t: flying_loads(t)[3:])
    return mbd.System([rod], forces=[push, twist], free=["rod"])


def flying_loads(t: Tensor) -> Tensor:
    """Force [N] and moment [N m] at the end of the flying rod [6, ...]."""
    moment = hat(t, 200.0, 2.5)
    return torch.stack([0.1 * moment, 0.0 * t, 0.0 * t, 0.0 * t, moment, 0.5 * moment])


def momenta(motion: mbd.results.Trajectory, name: str) -> tuple[Tensor, Tensor]:
    """Momentum and angular momentum about the origin of a beam [times, 3]."""
    own, linear, angular = motion.system.body(name).structure(), torch.zeros(1), torch.zeros(1)
    cross, eye = torch.linalg.cross, torch.eye(3, dtype=torch.float64)
    for k, (m, first, second) in enumerate(zip(own.mass, own.first, own.second, strict=True)):
        node = motion.body(f"{name}_{k}")
        A, r, v = node.A[0], node.r[0], node.at().velocity[0]
        spin, arm = (A @ node.omega[0, :, :, None])[..., 0], A @ first
        momentum = m * v + cross(spin, arm)
        inertia = second.diagonal().sum() * eye - second
        linear = linear + momentum
        angular = angular + cross(r, momentum) + cross(arm, v) + (A @ (inertia @ node.omega[0, :, :, None]))[..., 0]
    return linear, angular
