"""Bushing: springs and dampers along and about the three axes of a frame.

Displacements of the point of b in the axes of a, and for small rotations the angles of b against a about them.
Rotations are measured from the given initial positions. Where one axis is free, with neither stiffness nor damping about it, as
in a bearing, the tilt of this axis is measured: it does not depend on the turn about it, however far.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import nonnegative
from torchmbd.math.variable import number
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.forces.action import Along, Turn
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.forces.laws import Spring, one_or_three_numbers
from torchmbd.multibody.joints.joint import AttachmentTable, other_axes

_UNITS = {
    "stiffness": "N/m",
    "damping": "N s/m",
    "turning_stiffness": "N m/rad",
    "turning_damping": "N m s/rad",
}


class _Mount(Spring):
    """A spring and damper that give no energy, whatever the design."""

    nonnegative: ClassVar[tuple[str, ...]] = ("stiffness", "damping")


class Bushing(ForceElement):
    """An elastic mount between two frames: springs and dampers along three axes, and about them.

    a, b                                  the frames that it joins
    stiffness, damping                    along x, y, z of frame a [N/m], [N s/m], zero or positive
    turning_stiffness, turning_damping    about them [N m/rad], [N m s/rad]
    name                                  of the element, and of its design variables

    One number applies to all three axes. A number may be a design variable: "mount.stiffness", or "mount.stiffness_x" for
    one axis.

    >>> engine = mbd.RigidBody("engine", 50.0, (1.0, 1.0, 1.0))
    >>> mount = mbd.Bushing(mbd.Ground().at(), engine.at(), stiffness=(1e5, 1e5, 2e5), turning_stiffness=1e4, name="mount")
    >>> rest = mbd.equilibrium(mbd.System([engine], [], [mount], free=["engine"]))
    >>> rest.vibrations[0].frequencies.round(decimals=2).tolist()  # [Hz]
    [7.12, 7.12, 10.07, 15.92, 15.92, 15.92]
    """

    def __init__(
        self,
        a: Frame,
        b: Frame,
        stiffness: Sequence[float | Tensor] | float | Tensor,
        damping: Sequence[float | Tensor] | float | Tensor = 0.0,
        turning_stiffness: Sequence[float | Tensor] | float | Tensor = 0.0,
        turning_damping: Sequence[float | Tensor] | float | Tensor = 0.0,
        name: str | None = None,
    ):
        super().__init__((a, b), name)
        self.along = self._springs("", stiffness, damping)
        self.about = self._springs("turning_", turning_stiffness, turning_damping)
        if all(law == _Mount() for law in (*self.along, *self.about)):
            raise InputError(
                (self.name,),
                allowed="must have at least one of them",
                noun=repr(self.name),
                state="has neither stiffness nor damping",
            )

    def _springs(self, kind: str, *values: Any) -> list[Any]:
        """The laws of the three axes: of stiffness and damping."""
        labels = [f"{kind}stiffness", f"{kind}damping"]
        k, c = (one_or_three_numbers((self.name, label), x) for label, x in zip(labels, values, strict=True))
        for label, x in zip(labels, (k, c), strict=True):
            for y in x:
                nonnegative((self.name, label), number(y), _UNITS[label])
        result = []
        for i, axis in enumerate("xyz"):
            names = [
                label if x is argument else f"{label}_{axis}"
                for label, x, argument in zip(labels, (k[i], c[i]), values, strict=True)
            ]
            result.append(self.law_variables.law(_Mount(k[i], c[i]), stiffness=names[0], damping=names[1]))
        return result

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        free = [axis for axis, about in zip("xyz", self.about, strict=True) if about == _Mount()]
        for axis, along, about in zip("xyz", self.along, self.about, strict=True):
            if along != _Mount():
                yield Applied(Along, (attachments.point(a), attachments.point(b), attachments.axis(a, axis)), along)
            if about != _Mount():
                x, y = other_axes(axis)
                if free == [y]:
                    x, y = y, x  # the tilt of the free axis; its angle about -axis has the same linear spring
                yield Applied(
                    Turn, (attachments.axis(a, x), attachments.axis(a, y), attachments.coincident_axis(a, x, b)), about
                )
