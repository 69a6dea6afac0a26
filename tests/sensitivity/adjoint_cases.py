"""Small mechanisms whose gradients by going back through a motion are compared with those of tangents."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import box, laminate, pendulum, plate, soft_slider_crank, sprung
from tests.multibody.start.test_initial import four_bar
from tests.sensitivity.test_law_variables import arm, waves
from torchmbd.multibody.forces import Scaled, Spring
from torchmbd.multibody.system import System


def loose_chain() -> System:
    """So many bodies that their blocks are eliminated first; a law of a force would couple them."""
    bodies, ends = [], [mbd.Ground().at()]
    for i in range(8):
        one = box(f"b{i}", position=(0.3 * i + 0.1, 0.0, 0.0)) if i % 2 else plate(
            f"b{i}", 2, made_of=laminate((20.0 + 5 * i, -40.0)), cells=(4, 2), position=(0.3 * i + 0.15, 0.0, 0.0)
        )  # fmt: skip
        bodies.append(one)
    ends += [body.at(0.1, 0.0, 0.0) if i % 2 else body.at("right") for i, body in enumerate(bodies)]
    joints = []
    for i, body in enumerate(bodies):
        before = ends[i]
        start = body.at("left") if i % 2 == 0 else body.at()
        own = body.at("left") if i % 2 == 0 else start
        joints.append(mbd.Spherical(before, own))
    return System(bodies, joints, gravity=(1.0, -9.0, 2.0))


def contact(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """Of two spheres: the root of what is apart is nan, and not taken."""
    depth = 0.01 - s
    return torch.where(depth > 0.0, 50.0 * depth * torch.sqrt(depth), 0.0 * s)


def strung() -> System:
    """Forces of all kinds with design variables in their laws, and a contact that is open."""
    body = box("bob", position=(0.2, 0.0, 0.1), angular_velocity=(1.0, 2.0, 0.5))
    end = body.at(0.1, 0.05, 0.0)
    forces = [
        mbd.SpringDamper(mbd.Ground().at(), end, mbd.variable(40.0), mbd.variable(0.3), 0.1, name="cord"),
        mbd.RotationalSpringDamper(mbd.Ground().at(), end, law=Scaled(mbd.variable(0.5), Spring(2.0)), name="coil"),
        mbd.Force(end, (mbd.variable(0.3), 0.0, 0.1), name="push"),
        mbd.Torque(end, Scaled(mbd.variable(0.02), waves), name="twist"),
        mbd.SpringDamper(mbd.Ground().at(), end, law=contact, name="stop"),
    ]
    return System([body], [mbd.Spherical(mbd.Ground().at(0.2, 0.0, 0.1), body.at())], forces)


def soft_contact() -> System:
    """A law that pushes only from some distance on, and has a kink there."""

    def law(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return torch.where(s > 0.02, -3.0 * (s - 0.02) * s, 0.0 * s) - 0.01 * rate

    return sprung(law)


def closed() -> System:
    """A driven loop of rigid bars with redundant rows, and a soft plate that swings from one of them."""
    system = four_bar()
    left = system.bodies[0]
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3), position=(0.2, 0.2, 0.0), cells=(4, 2))
    joints = [*system.joints, mbd.Spherical(left.at(0.206155281280883, 0.0, 0.0), rod.at("left"))]
    return System([*system.bodies, rod], joints, gravity=(0.0, -9.81, 0.0))


def held() -> System:
    """A drive leaves nothing free: the equations of motion have no part in a gradient but by rounding."""
    crank, foot = box("crank"), mbd.Ground().at()
    joints = [mbd.Revolute(foot, crank.at()), mbd.Drive(foot, crank.at(), speed=mbd.variable(3.0), name="motor")]
    return System([crank], joints)


CASES: dict[str, tuple[Callable[[], System], float, int]] = {
    "driven": (lambda: soft_slider_crank((30.0, -20.0), cells=(6, 2)), 0.01, 25),
    "spatial": (pendulum, 0.04, 20),
    "forces": (sprung, 0.02, 15),
    "kink": (soft_contact, 0.02, 15),
    "laws of forces": (strung, 0.1, 40),
    "laws of drives": (lambda: arm("step"), 0.1, 20),
    "redundant": (closed, 0.02, 15),
    "many bodies": (loose_chain, 0.01, 5),
    "all held": (held, 0.1, 10),
}
