"""Forces in the joints of robots: springs, dampers, friction, actuators.

    spring, damper   -k (s - s0) - c s'                      "NAME_spring"; "NAME_damping" where there is no spring
                     - k2 x^2 - k3 x^3 - c2 s' |s'| - c3 s'^3   x = s - s0; further terms of MJCF
    friction         -f tanh(s' / friction_speed)            "NAME_friction"
    actuator         gear clamp(gain u + b0 + b1 gear s + b2 gear s')   "NAME"

Checked in tests/extensions/robots/test_robot.py, test_robot_mjcf.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.extensions.robots.tree import Actuator, RobotJoint
from torchmbd.math.checked_numbers import positive, scalar
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.forces.laws import Friction, Spring
from torchmbd.multibody.forces.spring_damper import AxialSpringDamper, RotationalSpringDamper

MOVING = ("revolute", "continuous", "prismatic")  # joints of one coordinate


def identifier(name: str) -> str:
    """A name of a file as a Python identifier, for a System."""
    cleaned = "".join(c if c.isalnum() or c == "_" else "_" for c in name)
    return cleaned if cleaned.isidentifier() else f"_{cleaned}"


def joint_forces(joint: RobotJoint, a: Any, b: Any, speed: float) -> list[ForceElement]:
    """Spring, damping and friction of a joint between two frames."""
    if joint.kind not in MOVING:
        return []
    laws: dict[str, Any] = {}
    springs, dampers = (joint.stiffness, *joint.spring_terms), (joint.damping, *joint.damper_terms)
    if any(springs) or any(dampers):
        further = any(springs[1:]) or any(dampers[1:])
        linear = Spring(joint.stiffness, joint.damping, joint.rest)
        laws["spring" if any(springs) else "damping"] = (
            PolynomialSpring(springs, dampers, joint.rest) if further else linear
        )
    if joint.friction:
        laws["friction"] = Friction(joint.friction, positive("friction_speed", speed, "rad/s or m/s"))
    return [_between(joint, a, b, law, f"{identifier(joint.name)}_{key}") for key, law in laws.items()]


def actuator_forces(
    actuators: Sequence[Actuator], joints: Mapping[str, tuple[RobotJoint, Any, Any]], controls: Mapping[str, Any]
) -> list[ForceElement]:
    """Forces of actuators; joints: name -> joint and its frames. Actuators without control and bias have no force."""
    names = [actuator.name for actuator in actuators]
    forces: list[ForceElement] = []
    for name in controls:
        if name not in names:
            raise unknown("controls:", name, names, ("controls", name))
    for actuator in actuators:
        least, largest = actuator.limits or (-math.inf, math.inf)
        control: Any = controls.get(actuator.name, min(max(0.0, least), largest))  # a number, or a function of time
        if not callable(control):
            control = scalar(f"controls[{actuator.name!r}]", control)
            if not least <= control <= largest:
                raise InputError(
                    ("controls", actuator.name),
                    control,
                    f"{least:g} to {largest:g}",
                    noun=f"controls[{actuator.name!r}]",
                    shown=f"{control:g}",
                )
        if actuator.joint in joints and (callable(control) or any((control, *actuator.bias))):
            joint, a, b = joints[actuator.joint]
            center = 0.5 * sum(joint.limits) if joint.limits else 0.0
            number_or_function: Any = control
            law = ActuatorLaw(number_or_function, actuator, center)
            forces.append(_between(joint, a, b, law, identifier(actuator.name)))
    return forces


@dataclass(frozen=True)
class PolynomialSpring:
    """Force of a spring and a damper as polynomials, with the signs of MuJoCo: even powers of the spring push one way.

    stiffness  factors of x, x^2, x^3, where x = s - rest;  damping: of v, v |v|, v^3
    """

    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    rest: float

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        x = s - self.rest
        force = torch.zeros_like(x)
        for n, k in enumerate(self.stiffness):
            force = force - k * x ** (n + 1)
        for n, c in enumerate(self.damping):
            force = force - c * rate * rate.abs() ** n
        return force


@dataclass(frozen=True)
class ActuatorLaw:
    """Force of an actuator as a law of the coordinate s of its joint, the rate and time; center: middle of the range of s."""

    control: Callable[[Tensor], Tensor] | float
    actuator: Actuator
    center: float = 0.0

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        x = self.actuator
        u = _limited(self.control(t), x.limits) if callable(self.control) else self.control
        force = x.gain * u + x.bias[0] + x.gear * (x.bias[1] * s + x.bias[2] * rate)
        return x.gear * _limited(force, x.forces)


def _limited(x: Tensor, limits: tuple[float, float] | None) -> Tensor:
    return x if limits is None else torch.clamp(x, *limits)


def _between(joint: RobotJoint, a: Any, b: Any, law: Any, name: str) -> ForceElement:
    kind = AxialSpringDamper if joint.kind == "prismatic" else RotationalSpringDamper
    return kind(a, b, axis="z", law=law, name=name)
