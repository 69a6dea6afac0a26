"""A textbook motion for each kind of joint: Hooke's joint, a screw, pucks on inclines, the conical pendulum, a mass on a guide.

Source: closed solutions; the speed ratio of Hooke's joint e.g. Shigley and Uicker, Theory of Machines and Mechanisms.
"""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor, turned

GROUND, G = mbd.Ground(), 9.81
LEAN = turned(0.5, -0.3, 0.9)
HANG = (0.0, 0.0, -G)


def ball(**given) -> mbd.RigidBody:
    return mbd.RigidBody("ball", 2.0, (0.02, 0.02, 0.02), **given)


def run(system: mbd.System, duration: float, steps: int = 100, **given) -> mbd.Trajectory:
    return mbd.simulate(system, duration, steps=steps, **({"iterations": (5, 1)} | given)).require_ok()


@pytest.mark.thorough
@pytest.mark.parametrize("bend", [20.0, 45.0])
def test_hookes_joint_turns_unevenly(bend):
    """tan phi = cos(bend) tan th; speeds between cos(bend) and 1 / cos(bend) of the driving shaft's, twice in a turn."""
    b, speed = math.radians(bend), 10.0
    R = turned(0.0, 0.0, b)
    driver = mbd.RigidBody("driver", 1.0, (0.01, 0.02, 0.02), position=(-0.2, 0.0, 0.0))
    driven = mbd.RigidBody("driven", 1.0, (0.01, 0.02, 0.02), position=R @ tensor(0.2, 0.0, 0.0), axes=R)
    joints = [
        mbd.Revolute(GROUND.at(-0.2, 0.0, 0.0), driver.at(), axis="x", name="one"),
        mbd.Revolute(GROUND.at(*(R @ tensor(0.2, 0.0, 0.0)).tolist(), axes=R), driven.at(), axis="x", name="two"),
        mbd.Universal(driver.at(0.2, 0.0, 0.0, axes=R), driven.at(-0.2, 0.0, 0.0), axes="zy", name="cross"),
        mbd.Drive(GROUND, driver, axis="x", speed=speed, name="motor"),
    ]
    motion = run(mbd.System([driver, driven], joints), 2.0 * math.pi / speed, 200)
    th = speed * motion.t
    phi = torch.atan2(math.cos(b) * torch.sin(th), torch.cos(th))
    arm = (driven.axes.T @ motion.body("driven").A[0])[:, :, 1]  # the cross's second arm, in the shaft's own axes
    assert_close(arm, torch.stack([0.0 * phi, torch.cos(phi), torch.sin(phi)], 1), rtol=0, atol=1e-7)
    ratio = math.cos(b) / (1.0 - (math.sin(b) * torch.sin(th)) ** 2)
    result = motion.body("driven").omega[0, :, 0] / speed
    assert_close(result, ratio, rtol=0, atol=2e-3)
    assert float(ratio.max()) == pytest.approx(1.0 / math.cos(b), rel=1e-3)


@pytest.mark.parametrize(("axes", "skew"), [("zy", "0.35"), ("yz", None)])
def test_a_skewed_cross_is_told(axes: str, skew: str | None):
    """Shafts along x, the second one turned about z by 20 degrees: its arm z is across both, y of the first is not."""
    R = turned(0.0, 0.0, math.radians(20.0))
    driver, driven = (mbd.RigidBody(name, 1.0, (0.01, 0.02, 0.02)) for name in ("driver", "driven"))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        mbd.Universal(driver.at(), driven.at(axes=R), axes=axes, name="cross")
    texts = [str(x.message) for x in told]
    assert len(texts) == (skew is not None)
    assert all("the cross of 'cross' is skewed at the start: its second arm, 'y' of driver" in x for x in texts)
    assert all(f"is {skew} rad from" in x for x in texts)


@pytest.mark.thorough
def test_a_cylindrical_joint_lets_a_body_screw_down():
    """Free along a leaning guide and about it: an even spin on an accelerated helix."""
    e = LEAN[:, 2]
    spin, start = 12.0, 0.3
    screw = ball(axes=LEAN, velocity=start * e, angular_velocity=(0.0, 0.0, spin))
    system = mbd.System(
        [screw], [mbd.Cylindrical(GROUND.at(axes=LEAN), screw.at(), axis="z", name="guide")], gravity=HANG
    )
    motion = run(system, 1.0)
    t = motion.t
    along = start * t - 0.5 * G * e[2] * t * t
    point = motion.body("ball").at((0.1, 0.0, 0.05)).position[0] @ LEAN
    c, s = torch.cos(spin * t), torch.sin(spin * t)
    assert_close(point, torch.stack([0.1 * c, 0.1 * s, along + 0.05], 1), rtol=0, atol=1e-5)
    across = 2.0 * G * math.sqrt(1.0 - float(e[2]) ** 2)
    assert_close(motion.reaction("guide").force[0].norm(dim=1), torch.full_like(t, across), rtol=1e-6, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["planar", "point"])
def test_pucks_slide_down_an_incline(kind):
    """In the plane they fall with what gravity has along it; the plane carries the rest. A ball turns as it likes."""
    n = LEAN[:, 2]
    spin = (0.0, 0.0, 3.0) if kind == "planar" else (1.0, -2.0, 3.0)
    puck = ball(axes=LEAN, angular_velocity=spin)
    joint = (mbd.Planar if kind == "planar" else mbd.PointOnPlane)(
        GROUND.at(axes=LEAN), puck.at(), normal="z", name="plane"
    )
    motion = run(mbd.System([puck], [joint], gravity=HANG), 0.5)
    g = tensor(*HANG)
    down = g - (g @ n) * n
    assert_close(motion.body("ball").r[0], 0.5 * motion.t[:, None] ** 2 * down, rtol=0, atol=1e-9)
    assert_close(motion.body("ball").omega[0], tensor(*spin).expand(len(motion.t), 3), rtol=0, atol=1e-9)
    carried = motion.reaction("plane").force[0]
    assert_close(carried, tensor(0.0, 0.0, -2.0 * float(g @ n)).expand_as(carried), rtol=0, atol=1e-6)


@pytest.mark.thorough
def test_a_link_carries_a_conical_pendulum():
    """rate^2 = g / (L cos al), force m g / cos al."""
    L, al = 0.5, math.radians(40.0)
    rate, r = math.sqrt(G / (L * math.cos(al))), L * math.sin(al)
    bob = ball(position=(r, 0.0, -L * math.cos(al)), velocity=(0.0, rate * r, 0.0))
    system = mbd.System([bob], [mbd.DistanceJoint(GROUND.at(), bob.at(), L, name="link")], gravity=HANG)
    motion = run(system, 2.0 * math.pi / rate, 200)
    expected = [
        r * torch.cos(rate * motion.t),
        r * torch.sin(rate * motion.t),
        torch.full_like(motion.t, -L * math.cos(al)),
    ]
    assert_close(motion.body("ball").r[0], torch.stack(expected, 1), rtol=0, atol=1e-3 * r)
    force = motion.reaction("link").force[0].norm(dim=1)
    assert_close(force[5:], torch.full_like(force[5:], 2.0 * G / math.cos(al)), rtol=2e-3, atol=0)


@pytest.mark.thorough
def test_a_mass_on_a_guide_with_a_spring():
    """x = x0 cos(w t) about where spring and weight balance."""
    e, stiffness = LEAN[:, 0], 80.0
    w, rest = math.sqrt(stiffness / 2.0), -2.0 * G * float(e[2]) / stiffness
    mass = ball(position=(rest + 0.1) * e, axes=LEAN)
    guide = GROUND.at(axes=LEAN)
    spring = mbd.AxialSpringDamper(guide, mass.at(), axis="x", stiffness=stiffness)
    system = mbd.System([mass], [mbd.Prismatic(guide, mass.at(), axis="x")], [spring], gravity=HANG)
    motion = run(system, 2.0 * math.pi / w, 200)
    x: Tensor = motion.body("ball").r[0] @ e
    assert_close(x, rest + 0.1 * torch.cos(w * motion.t), rtol=0, atol=1e-4)
