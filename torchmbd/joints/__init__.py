"""Joints: lists of constraint primitives between frames. A new joint is one file and one line here."""

from torchmbd.joints.cylindrical import Cylindrical
from torchmbd.joints.distance import Distance
from torchmbd.joints.drive import Drive
from torchmbd.joints.fixed import Fixed
from torchmbd.joints.joint import Joint
from torchmbd.joints.laws import ConstantSpeed, Sine, SmoothStep
from torchmbd.joints.planar import Planar
from torchmbd.joints.point_on_plane import PointOnPlane
from torchmbd.joints.prismatic import Prismatic
from torchmbd.joints.revolute import Revolute
from torchmbd.joints.spherical import Spherical
from torchmbd.joints.universal import Universal

JOINTS: dict[str, type[Joint]] = {
    kind.__name__.lower(): kind
    for kind in (Cylindrical, Distance, Drive, Fixed, Planar, PointOnPlane, Prismatic, Revolute, Spherical, Universal)
}

__all__ = [
    "JOINTS",
    "ConstantSpeed",
    "Cylindrical",
    "Distance",
    "Drive",
    "Fixed",
    "Joint",
    "Planar",
    "PointOnPlane",
    "Prismatic",
    "Revolute",
    "Sine",
    "SmoothStep",
    "Spherical",
    "Universal",
]
