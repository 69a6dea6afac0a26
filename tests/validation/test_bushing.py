"""A bushing under large rotations, against closed forms.

    turning   J th'' + c th' + k th = 0 about an axis of frame a: th = w0 / wd exp(-d t) sin(wd t), linear up to half a turn
    sliding   a mass in the axes of a disk that a motor turns at rate W, with x, y in these axes:
              x'' - 2 W y' - W^2 x = -(kx x + cx x') / m,   y'' + 2 W x' - W^2 y = -(ky y + cy y') / m
Source: textbook dynamics: damped vibration, and the equations of a particle in a rotating frame.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor, turned

pytestmark = pytest.mark.usefixtures("compiled")

GROUND = mbd.Ground()
LEAN = turned(0.4, -0.7, 0.5)
INERTIA = tensor(2e-3, 3e-3, 4e-3)
AXES = torch.eye(3, dtype=torch.float64)


def turning(axis: str, largest: float, stiffness: Tensor, damping: Tensor) -> tuple[mbd.Trajectory, Tensor]:
    """The angle [times] of a body on a leaning hinge and a bushing at it, and that of the closed form."""
    i = "xyz".index(axis)
    J, k, c = float(INERTIA[i]), float(stiffness[i]), float(damping[i])
    d = c / (2.0 * J)
    wd = math.sqrt(k / J - d * d)
    spin = (largest * wd) * AXES[i]
    body = mbd.RigidBody("rotor", 1.0, INERTIA, axes=LEAN, angular_velocity=spin)
    foot, own = GROUND.at(axes=LEAN), body.at()
    bushing = mbd.Bushing(
        foot, own, stiffness=0.0, turning_stiffness=stiffness.tolist(), turning_damping=damping.tolist()
    )
    system = mbd.System([body], [mbd.Revolute(foot, own, axis=axis)], [bushing])
    motion = mbd.simulate(system, 0.15, steps=400, spectral_radius=1.0).require_ok()
    A = LEAN.T @ motion.body("rotor").A[0]
    y, z = (i + 1) % 3, (i + 2) % 3
    angle = torch.atan2(A[:, z, y], A[:, y, y])
    t = motion.t
    return motion, torch.stack([angle, largest * torch.exp(-d * t) * torch.sin(wd * t)])


@pytest.mark.thorough
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_all_three_springs_about_one_axis(axis):
    """Up to 1.2 rad: those of the other two axes do not see it."""
    _, (result, expected) = turning(axis, 1.2, tensor(3.0, 5.0, 8.0), tensor(0.01, 0.02, 0.03))
    assert float(expected.abs().max()) > 0.7
    assert_close(result, expected, rtol=0, atol=2e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_one_spring_beyond_a_right_angle(axis):
    """Up to 2.5 rad: linear in the angle itself, not in its sine."""
    only = 6.0 * AXES["xyz".index(axis)]
    _, (result, expected) = turning(axis, 2.5, only, 0.0 * only)
    assert float(expected.abs().max()) > 2.4
    assert_close(result, expected, rtol=0, atol=2e-3)


@pytest.mark.thorough
def test_springs_slide_along_the_axes_of_a_frame_that_turns():
    """Two turns of the disk: unequal springs keep to its axes."""
    rate, m, kx, ky, cx, cy = 30.0, 0.5, 4000.0, 9000.0, 1.0, 4.0
    start, speed = tensor(0.02, -0.01), tensor(0.3, 0.2)
    disk = mbd.RigidBody("disk", 1.0, (1e-2, 1e-2, 1e-2), axes=LEAN)
    # In the disk's axes it moves at `speed`: seen from the ground the turning adds.
    v = LEAN @ tensor(speed[0] - rate * start[1], speed[1] + rate * start[0], 0.0)
    mass = mbd.RigidBody(
        "mass", m, (1e-3, 1e-3, 1e-3), position=LEAN @ tensor(*start.tolist(), 0.0), axes=LEAN, velocity=v
    )
    foot = GROUND.at(axes=LEAN)
    joints = [mbd.Revolute(foot, disk.at(), axis="z"), mbd.Drive(foot, disk, axis="z", speed=rate)]
    bushing = mbd.Bushing(disk.at(), mass.at(), stiffness=(kx, ky, 100.0), damping=(cx, cy, 0.0))
    system = mbd.System([disk, mass], joints, [bushing], free=["mass"])
    motion = mbd.simulate(system, 4.0 * math.pi / rate, "dopri8", steps=12, rtol=1e-10, atol=1e-13).require_ok()
    seen = torch.einsum("tji,tj->ti", motion.body("disk").A[0], motion.body("mass").r[0])
    matrix = [
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [rate**2 - kx / m, 0.0, -cx / m, 2.0 * rate],
        [0.0, rate**2 - ky / m, -2.0 * rate, -cy / m],
    ]
    expected = torch.stack([torch.from_numpy(expm(float(t) * np.array(matrix))) for t in motion.t]) @ torch.cat(
        [start, speed]
    )
    assert_close(seen[:, :2], expected[:, :2], rtol=0, atol=1e-7)
    assert float(seen[:, 2].abs().max()) < 1e-9
