"""A05, the stiff flyball governor: rods on a shaft, spring-dampers of 8e5 N/m and 4e4 N s/m instead of couplers.

Data: IFToMM library of computational benchmark problems, A05 (Gonzalez, Dopico, Lugris, Cuadrado, Multibody Syst. Dyn. 16
(2006) 179-190): shaft and rods 1 x 0.01 x 0.01 m, slider 0.1 m cube, density 3000 kg/m3, two masses of 5 kg, free length
0.5 m, s = 0.5 m, 30 degrees, 2 pi rad/s. The library shows its reference as a curve; the reference here is the same
mechanism in three coordinates (turn of the shaft, angle of the rods, place of the slider), by SciPy's Radau at 1e-11.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchmbd as mbd
from tests.mechanisms import tensor

G, K, C, FREE = 9.81, 8e5, 4e4, 0.5
RATE, TILT = 2.0 * math.pi, math.radians(30.0)
BAR, CUBE, BALL = 0.3, 3.0, 5.0  # masses [kg]
LONG, ACROSS = BAR * 2e-4 / 12.0, BAR * (1.0 + 1e-4) / 12.0  # inertia of a bar about its axis and across it
BLOCK = CUBE * 0.02 / 12.0


def governor() -> mbd.System:
    """z is up, the rods hang on the upper end of the shaft at the origin, 30 degrees below the horizontal."""
    ground = mbd.Ground()
    spin = {"angular_velocity": (0.0, 0.0, RATE)}
    shaft = mbd.RigidBody("shaft", BAR, (ACROSS, ACROSS, LONG), position=(0.0, 0.0, -0.5), **spin)
    slider = mbd.RigidBody("slider", CUBE, (BLOCK, BLOCK, BLOCK), position=(0.0, 0.0, -0.5), **spin)
    joints = [
        mbd.Revolute(ground.at(), shaft.at(0.0, 0.0, 0.5), "z", name="bearing"),
        mbd.Prismatic(shaft.at(), slider.at(), "z", name="guide"),
    ]
    forces, rods = [], []
    c, s = math.cos(TILT), math.sin(TILT)
    for name, side in (("left", -1.0), ("right", 1.0)):
        axes = torch.stack([tensor(side * c, 0.0, -s), tensor(0.0, side, 0.0), tensor(side * s, 0.0, c)], 1)
        turn = axes.T @ tensor(0.0, 0.0, RATE)
        at = 0.5 * axes[:, 0]
        mass, far = BAR + BALL, BALL / (BAR + BALL) * 0.5  # the ball sits at the end, 0.5 m from the middle of the bar
        J = ACROSS + BAR * far**2 + BALL * (0.5 - far) ** 2
        moving = {"velocity": torch.linalg.cross(tensor(0.0, 0.0, RATE), at), "angular_velocity": turn}
        rod = mbd.RigidBody(name, mass, (LONG, J, J), center=(far, 0.0, 0.0), position=at, axes=axes, **moving)
        hinge = shaft.at(0.0, 0.0, 0.5)
        joints.append(mbd.Revolute(hinge, rod.at(-0.5, 0.0, 0.0), "y", name=f"hinge_{name}"))
        forces.append(mbd.SpringDamper(rod.at(), slider.at(), stiffness=K, damping=C, rest=FREE, name=f"spring_{name}"))
        rods.append(rod)
    return mbd.System([shaft, slider, *rods], joints, forces, gravity=(0.0, 0.0, -G))


@functools.cache
def reference(duration: float, times: int) -> np.ndarray:
    """Turn, tilt and place s of the slider below the top [3, times]."""
    across = ACROSS + BAR / 4.0 + BALL

    def turning(al: float) -> float:
        return LONG + BLOCK + 2.0 * (across * math.cos(al) ** 2 + LONG * math.sin(al) ** 2)

    momentum = turning(TILT) * RATE

    def rates(_: float, x: np.ndarray) -> list[float]:
        _, al, s, al_rate, s_rate = x
        w = momentum / turning(al)
        c, si = math.cos(al), math.sin(al)
        length = math.hypot(0.5 * c, s - 0.5 * si)
        by_al, by_s = (-0.25 * c * si - 0.5 * c * (s - 0.5 * si)) / length, (s - 0.5 * si) / length
        pull = K * (length - FREE) + C * (by_al * al_rate + by_s * s_rate)  # tension of a spring
        al_force = 2.0 * ((0.5 * BAR + BALL) * G * c - pull * by_al - (across - LONG) * c * si * w * w)
        return [w, al_rate, s_rate, al_force / (2.0 * across), (CUBE * G - 2.0 * pull * by_s) / CUBE]

    t = np.linspace(0.0, duration, times)
    start = [0.0, TILT, 0.5, 0.0, 0.0]
    return solve_ivp(rates, (0.0, duration), start, "Radau", t, rtol=1e-11, atol=1e-12).y[:3]


def place(steps: int, duration: float, every: int) -> tuple[np.ndarray, np.ndarray]:
    """s of the slider and height of a ball over time."""
    motion = mbd.simulate(governor(), duration, steps=steps, iterations=(4, 4), spectral_radius=0.8).require_ok()
    assert float(motion.energies.balance.abs().max()) < 1e-3 * float(motion.energies.kinetic.max())
    s = -motion.body("slider").r[0, ::every, 2]
    ball = motion.body("left").at((0.5, 0.0, 0.0)).position[0, ::every, 2]
    return s.numpy(), ball.numpy()


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [0.2, pytest.param(2.0, marks=pytest.mark.slow)])
def test_the_slider_and_the_balls(duration):
    """Second order, and extrapolated from two step sizes the reference to 1e-6."""
    steps = round(500 * duration)
    coarse, fine = place(steps, duration, steps // 20), place(2 * steps, duration, steps // 10)
    _, al, s = reference(duration, 21)
    for one, two, expected in zip(coarse, fine, (s, -np.sin(al)), strict=True):
        assert np.abs(expected - expected[0]).max() > 1e-2
        assert np.abs(two - expected).max() < 1e-4
        assert np.abs((4.0 * two - one) / 3.0 - expected).max() < 1e-6


def test_rows_and_freedoms():
    """The turn of the shaft, the slider and the two rods are free."""
    result = governor().describe()
    assert (result.rows, result.rank, result.freedoms) == (20, 20, 4)
    assert result.mass == pytest.approx(2 * BALL + 3 * BAR + CUBE)
