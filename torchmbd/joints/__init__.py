"""Joints: lists of constraint primitives between frames. A new joint is one file and one line here."""

from torchmbd.joints.cylindrical import Cylindrical
from torchmbd.joints.distance import Distance
from torchmbd.joints.drive import Drive
from torchmbd.joints.fixed import Fixed
from torchmbd.joints.joint import Joint
from torchmbd.joints.prismatic import Prismatic
from torchmbd.joints.revolute import Revolute
from torchmbd.joints.spherical import Spherical
from torchmbd.joints.universal import Universal

JOINTS: dict[str, type[Joint]] = {
    kind.__name__.lower(): kind
    for kind in (Cylindrical, Distance, Drive, Fixed, Prismatic, Revolute, Spherical, Universal)
}

__all__ = [
    "JOINTS",
    "Cylindrical",
    "Distance",
    "Drive",
    "Fixed",
    "Joint",
    "Prismatic",
    "Revolute",
    "Spherical",
    "Universal",
]
