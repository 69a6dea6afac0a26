"""Bushing: springs and dampers along and about the three axes of a frame.

Displacements of the point of b in the axes of a, and for small rotations the angles of b against a about them.
Rotations are measured from the given initial positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from torchmbd.bodies.frame import Frame
from torchmbd.forces.action import Along, Turn
from torchmbd.forces.force import Applied, ForceElement
from torchmbd.forces.laws import Spring, numbers
from torchmbd.joints.joint import Scribe, others


class Bushing(ForceElement):
    """`Bushing(a, b, stiffness=(kx, ky, kz), damping=..., turning_stiffness=(kxx, kyy, kzz), turning_damping=...)`.

    [N/m], [N s/m], [N m/rad], [N m s/rad]; one number stands for all three axes
    """

    def __init__(
        self,
        a: Frame,
        b: Frame,
        stiffness: Sequence[float] | float,
        damping: Sequence[float] | float = 0.0,
        turning_stiffness: Sequence[float] | float = 0.0,
        turning_damping: Sequence[float] | float = 0.0,
        name: str | None = None,
    ):
        super().__init__((a, b), name)
        given = {
            "stiffness": stiffness,
            "damping": damping,
            "turning_stiffness": turning_stiffness,
            "turning_damping": turning_damping,
        }
        k, c, kt, ct = (numbers(f"{key} of {self.name!r}", x, 3) for key, x in given.items())
        self.along = [Spring(*pair) for pair in zip(k, c, strict=True)]
        self.about = [Spring(*pair) for pair in zip(kt, ct, strict=True)]

    def actions(self, scribe: Scribe) -> Iterator[Applied]:
        a, b = self.frames
        for axis, along, about in zip("xyz", self.along, self.about, strict=True):
            if along.stiffness or along.damping:
                yield Applied(Along, (scribe.point(a), scribe.point(b), scribe.axis(a, axis)), along)
            if about.stiffness or about.damping:
                x, y = others(axis)
                yield Applied(Turn, (scribe.axis(a, x), scribe.axis(a, y), scribe.twin(a, x, b)), about)
