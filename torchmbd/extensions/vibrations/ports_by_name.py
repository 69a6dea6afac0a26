"""Inputs and outputs of harmonic responses by names, as measures and experiment files have them.

    output   the angle or travel of a joint, or the position of a point of a body in a direction
    input    the effort of a motor in a joint, or a force on a point of a body in a direction

Checked in tests/extensions/vibrations/measures/test_frequency_response.py, tests/extensions/identification/test_files.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torchmbd.errors import InputError, one_of
from torchmbd.math.checked_numbers import is_whole
from torchmbd.multibody.bodies.frame import Frame, axis_index, vector
from torchmbd.multibody.bodies.rigid import RigidBody
from torchmbd.multibody.forces import signals
from torchmbd.multibody.joints.prismatic import Prismatic
from torchmbd.multibody.joints.revolute import Revolute
from torchmbd.multibody.system import System
from torchmbd.results.reaction import joint_named

Place = str | int | Sequence[float] | None


@dataclass(frozen=True)
class NamedPort:
    """A joint, or a point of a body in a direction; `labels`: what the three are called in messages.

    name        of a joint or a body
    direction   "x", "y", "z" of the ground, at every turn of a rotation; None: a joint
    place       a node of a flexible body, or (x, y, z) on a rigid one [m]; None: its origin
    """

    name: str
    direction: str | None = None
    place: Place = None
    labels: tuple[str, str, str] = ("name", "direction", "place")

    def __post_init__(self) -> None:
        name, direction, place = self.labels
        if not isinstance(self.name, str):
            raise InputError(name, self.name, "the name of a joint or of a body")
        if self.direction is not None:
            one_of(direction, self.direction, "xyz")
        x: Any = self.place
        if x is not None and not isinstance(x, str) and not is_whole(x):
            object.__setattr__(self, "place", tuple(vector(place, x).tolist()))

    def output(self, system: System) -> tuple[signals.Signal, int]:
        """The signal, and which of its numbers."""
        at = self._of(system)
        if isinstance(at, Frame):
            assert self.direction is not None
            return signals.PointPosition(at), axis_index(self.direction)
        return (signals.JointAngle if isinstance(at, Revolute) else signals.JointTravel)(at), 0

    def input(self, system: System) -> signals.Actuator:
        """The actuator."""
        at = self._of(system)
        if isinstance(at, Frame):
            assert self.direction is not None
            return signals.ForceOn(at, self.direction)
        return (signals.JointTorque if isinstance(at, Revolute) else signals.JointForce)(at)

    def _of(self, system: System) -> Any:
        """The joint, or a frame of the body."""
        argument, direction, place = self.labels
        joints = {joint.name for joint in system.joints}
        if self.name in joints:
            joint: Any = joint_named(system, self.name)
            if not isinstance(joint, (Revolute, Prismatic)):
                raise InputError(
                    argument,
                    self.name,
                    "a revolute or prismatic joint, or a body",
                    shown=f"{self.name!r}, a {type(joint).__name__}",
                )
            for label, x in ((direction, self.direction), (place, self.place)):
                if x is not None:
                    raise InputError(label, x, "given with a body alone", state=f"is {x!r} with joint {self.name!r}")
            return joint
        bodies = sorted(body.name for body in (*system.bodies, *system.beams))
        if self.name not in bodies:
            raise InputError(argument, self.name, f"one of the joints {sorted(joints)} or of the bodies {bodies}")
        if self.direction is None:
            raise InputError(str(direction), allowed="'x', 'y' or 'z'", state=f"is None with body {self.name!r}")
        body: Any = system.body(self.name)
        at: Any = self.place
        if isinstance(body, RigidBody):
            if at is not None and not isinstance(at, tuple):
                raise InputError(
                    str(place), at, "a point (x, y, z) [m]", state=f"is {at!r} on the rigid body {self.name!r}"
                )
            return body.at(*(at or ()))
        if at is None or isinstance(at, tuple):
            raise InputError(str(place), at, "a node", state=f"is {at!r} on the flexible body {self.name!r}")
        return body.at(at)
