"""Forces in the joints of robots: springs, dampers, friction, actuators.

    spring, damper   -k (s - s0) - c s'                      "NAME_spring"; "NAME_damping" where there is no spring
    friction         -f tanh(s' / friction_speed)            "NAME_friction"
    actuator         gear clamp(gain u + b0 + b1 gear s + b2 gear s')   "NAME"

Checked in tests/multibody/system/test_robot.py, test_robot_mjcf.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.io.robot_file import Actuator, RobotJoint
from torchmbd.math.checked_numbers import positive, scalar
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.forces.laws import Friction, Spring
from torchmbd.multibody.forces.spring_damper import AxialSpringDamper, RotationalSpringDamper

MOVING = ("revolute", "continuous", "prismatic")  # joints of one coordinate


def identifier(name: str) -> str:
    """A name of a file as one of a system."""
    made = "".join(c if c.isalnum() or c == "_" else "_" for c in name)
    return made if made.isidentifier() else f"_{made}"


def joint_forces(joint: RobotJoint, a: Any, b: Any, speed: float) -> list[ForceElement]:
    """Spring, damping and friction of a joint between two frames."""
    if joint.kind not in MOVING:
        return []
    laws: dict[str, Any] = {}
    if joint.stiffness:
        laws["spring"] = Spring(joint.stiffness, joint.damping, joint.rest)
    elif joint.damping:
        laws["damping"] = Spring(damping=joint.damping)
    if joint.friction:
        laws["friction"] = Friction(joint.friction, positive("friction_speed", speed, "rad/s or m/s"))
    return [_between(joint, a, b, law, f"{identifier(joint.name)}_{key}") for key, law in laws.items()]


def actuator_forces(
    actuators: Sequence[Actuator], joints: Mapping[str, tuple[RobotJoint, Any, Any]], controls: Mapping[str, Any]
) -> list[ForceElement]:
    """Actuators on joints, which stand with their frames; those without control and bias have no force."""
    names = [actuator.name for actuator in actuators]
    forces: list[ForceElement] = []
    for name in controls:
        if name not in names:
            raise unknown("controls:", name, names)
    for own in actuators:
        least, largest = own.limits or (-math.inf, math.inf)
        given: Any = controls.get(own.name, min(max(0.0, least), largest))
        if not callable(given) and not least <= (given := scalar(f"controls[{own.name!r}]", given)) <= largest:
            raise InputError(f"controls[{own.name!r}] is {given:g}; allowed: from {least:g} to {largest:g}")
        if own.joint in joints and (callable(given) or any((given, *own.bias))):
            joint, a, b = joints[own.joint]
            center = 0.5 * sum(joint.limits) if joint.limits else 0.0
            control: Any = given  # a number, or a function of time
            law = ActuatorLaw(control, own, center)
            forces.append(_between(joint, a, b, law, identifier(own.name)))
    return forces


@dataclass(frozen=True)
class ActuatorLaw:
    """Force of an actuator by the coordinate of its joint, its rate and time."""

    control: Callable[[Tensor], Tensor] | float
    actuator: Actuator
    center: float = 0.0

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        own = self.actuator
        u = _limited(self.control(t), own.limits) if callable(self.control) else self.control
        force = own.gain * u + own.bias[0] + own.gear * (own.bias[1] * s + own.bias[2] * rate)
        return own.gear * _limited(force, own.forces)


def _limited(x: Tensor, limits: tuple[float, float] | None) -> Tensor:
    return x if limits is None else torch.clamp(x, *limits)


def _between(joint: RobotJoint, a: Any, b: Any, law: Any, name: str) -> ForceElement:
    kind = AxialSpringDamper if joint.kind == "prismatic" else RotationalSpringDamper
    return kind(a, b, axis="z", law=law, name=name)
