"""The largest response of the whole system to a harmonic force or torque over a band of frequencies.

    FrequencyResponse("tip", "motor", band=(5.0, 40.0), direction="y") <= 1e-3        [m/(N m)]

The input is a unit force on a body, or the unit effort of a motor in a joint; the output is the position of a point of a body,
or the angle or travel of a joint, or its rates. Inputs and outputs are those of `mbd.linearize`, about the same states as other
measures of vibrations (system_vibrations.py).
Checked in tests/design/test_frequency_response.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

from torchmbd.design.system_vibrations import OfVibrations, rising
from torchmbd.errors import InputError, checked_signature, one_of
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole, nonnegative
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.bodies.frame import Frame, axis_index, vector
from torchmbd.multibody.bodies.rigid import RigidBody
from torchmbd.multibody.forces import signals
from torchmbd.multibody.joints.prismatic import Prismatic
from torchmbd.multibody.joints.revolute import Revolute
from torchmbd.multibody.system import System
from torchmbd.results.reaction import joint_named
from torchmbd.vibrations.largest_response import largest_response
from torchmbd.vibrations.linear_system import Ports, system_with_ports
from torchmbd.vibrations.steady_states import steady_states

QUANTITIES = ("displacement", "velocity", "acceleration")
Place = str | int | Sequence[float] | None


class ResponsePeak(NamedTuple):
    """The largest response of each design.

    magnitude   [lanes], differentiable
    frequency   [lanes] [Hz], without derivatives
    where       "peak", or the end of the band at which it is: there the response may be larger outside

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.01, steps=2)
    >>> mbd.FrequencyResponse("hinge", "hinge", band=(0.6, 2.0)).peak(motion).where  # above the only vibration, 0.498 Hz
    ['lower end of the band']
    """

    magnitude: Tensor
    frequency: Tensor
    where: list[str]


@checked_signature
@dataclass(frozen=True)
class FrequencyResponse(OfVibrations):
    """Largest magnitude [lanes] of a response to a harmonic input of size one over a band of frequencies; limit: at most.

    output      name of a joint, of which it is the angle [rad] or the travel [m]; or of a body: the position of a point [m]
    input       name of a joint, in which a motor acts [N m] or [N]; or of a body on which a force acts [N]
    band        (lowest, highest) frequency [Hz]
    direction   of the position: "x", "y", "z" of the ground; None: output is a joint
    place       of the point: a node of a flexible body, or (x, y, z) on a rigid one [m]; None: its origin
    input_direction, input_place   of the force, as of the position
    quantity    "displacement", or its rates "velocity", "acceleration"
    speed       of rotation [rad/s]
    axis, center, observer   of the rotation, as of OfVibrations

    The peak is located exactly, not on a grid. Its derivative is that of the magnitude at its frequency; where two peaks
    are the largest it is that of one of them.
    Raises InputError where a vibration in the band has no damping: the response is infinite.

    >>> body = mbd.RigidBody("load", 2.0, (1.0, 1.0, 1.0))
    >>> rail = mbd.Prismatic(mbd.Ground().at(), body.at(), axis="y", name="rail")
    >>> spring = mbd.AxialSpringDamper(mbd.Ground().at(), body.at(), axis="y", stiffness=50.0, damping=2.0)
    >>> motion = mbd.simulate(mbd.System([body], [rail], [spring]), 0.01, steps=2)
    >>> largest = mbd.FrequencyResponse("rail", "rail", band=(0.1, 10.0))
    >>> round(largest(motion).item(), 6)  # 1 / (k 2 zeta sqrt(1 - zeta^2)), zeta = 0.1
    0.100504
    >>> largest.peak(motion).where, round(largest.peak(motion).frequency.item(), 4)
    (['peak'], 0.7878)
    """

    output: str
    input: str
    band: tuple[float, float] = (1.0, 100.0)
    direction: str | None = None
    place: Place = None
    input_direction: str | None = None
    input_place: Place = None
    quantity: str = QUANTITIES[0]
    speed: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("output", "input"):
            x = getattr(self, name)
            if not isinstance(x, str):
                raise InputError(f"{name} is {x!r}; allowed: the name of a joint or of a body")
        for name in ("direction", "input_direction"):
            if getattr(self, name) is not None:
                one_of(name, getattr(self, name), "xyz")
        for name in ("place", "input_place"):
            x = getattr(self, name)
            if x is not None and not isinstance(x, str) and not is_whole(x):
                object.__setattr__(self, name, tuple(vector(name, x).tolist()))
        band = rising("band", self.band)
        nonnegative("band", band[0], "Hz")
        object.__setattr__(self, "band", band)
        one_of("quantity", self.quantity, QUANTITIES)
        nonnegative("speed", self.speed, "rad/s")

    def check(self, system: System) -> None:
        self._ports(system)

    def value(self, motion: Trajectory) -> Tensor:
        return self.peak(motion).magnitude

    def peak(self, motion: Trajectory) -> ResponsePeak:
        """The largest response with its frequency, and whether it is at an end of the band."""
        (output, row), actuator = self._ports(motion.system)

        def probed() -> tuple[System, Ports]:
            ports = Ports(1)
            return system_with_ports(motion.system, ports, [actuator], [output]), ports

        system, ports = outside_transforms(probed)
        states = steady_states(system, [float(self.speed)], self.shaft, motion.designs)
        low, high = self.band
        band = 2.0 * math.pi * low, 2.0 * math.pi * high
        found = largest_response(states, ports, row, QUANTITIES.index(self.quantity), band)
        return ResponsePeak(found.magnitude, found.frequency / (2.0 * math.pi), found.where)

    def _ports(self, system: System) -> tuple[tuple[signals.Signal, int], signals.Actuator]:
        """The signal of the output with the number of its component, and the actuator."""
        output = self._port(system, "output", self.output, "direction", "place")
        source = self._port(system, "input", self.input, "input_direction", "input_place")
        if isinstance(output, Frame):
            assert self.direction is not None
            signal = signals.PointPosition(output), axis_index(self.direction)
        else:
            signal = (signals.JointAngle if isinstance(output, Revolute) else signals.JointTravel)(output), 0
        if isinstance(source, Frame):
            assert self.input_direction is not None
            return signal, signals.ForceOn(source, self.input_direction)
        return signal, (signals.JointTorque if isinstance(source, Revolute) else signals.JointForce)(source)

    def _port(self, system: System, argument: str, name: str, direction: str, place: str) -> Any:
        """A joint, or a frame of a body."""
        joints, at = {joint.name for joint in system.joints}, getattr(self, place)
        if name in joints:
            joint: Any = joint_named(system, name)
            if not isinstance(joint, (Revolute, Prismatic)):
                raise InputError(
                    f"{argument} is {name!r}, a {type(joint).__name__}; allowed: revolute and prismatic joints, bodies"
                )
            for other in (direction, place):
                if getattr(self, other) is not None:
                    raise InputError(f"{other} is {getattr(self, other)!r} with joint {name!r}; allowed: with a body")
            return joint
        bodies = sorted(body.name for body in (*system.bodies, *system.beams))
        if name not in bodies:
            raise InputError(f"{argument} is {name!r}; allowed: joints {sorted(joints)}, bodies {bodies}")
        if getattr(self, direction) is None:
            raise InputError(f"{direction} is None with body {name!r}; allowed: 'x', 'y', 'z'")
        body: Any = system.body(name)
        if isinstance(body, RigidBody):
            if at is not None and not isinstance(at, tuple):
                raise InputError(f"{place} is {at!r} on the rigid body {name!r}; allowed: a point (x, y, z) [m]")
            return body.at(*(at or ()))
        if at is None or isinstance(at, tuple):
            raise InputError(f"{place} is {at!r} on the flexible body {name!r}; allowed: a node")
        return body.at(at)
