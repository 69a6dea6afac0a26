"""Joints: lists of constraint primitives between frames. A new joint is one file and one line here."""

from torchmbd.multibody.joints.cylindrical import Cylindrical
from torchmbd.multibody.joints.distance_joint import DistanceJoint
from torchmbd.multibody.joints.drive import Drive
from torchmbd.multibody.joints.fixed import Fixed
from torchmbd.multibody.joints.joint import Joint
from torchmbd.multibody.joints.joint_coupling import JointCoupling
from torchmbd.multibody.joints.laws import ConstantSpeed, Sine, SmoothStep
from torchmbd.multibody.joints.planar import Planar
from torchmbd.multibody.joints.point_on_curve import PointOnCurve
from torchmbd.multibody.joints.point_on_plane import PointOnPlane
from torchmbd.multibody.joints.prismatic import Prismatic
from torchmbd.multibody.joints.revolute import Revolute
from torchmbd.multibody.joints.spherical import Spherical
from torchmbd.multibody.joints.universal import Universal

JOINTS: dict[str, type[Joint]] = {
    kind.__name__.lower(): kind
    for kind in (
        Cylindrical,
        DistanceJoint,
        Drive,
        Fixed,
        JointCoupling,
        Planar,
        PointOnCurve,
        PointOnPlane,
        Prismatic,
        Revolute,
        Spherical,
        Universal,
    )
}

__all__ = [
    "JOINTS",
    "ConstantSpeed",
    "Cylindrical",
    "DistanceJoint",
    "Drive",
    "Fixed",
    "Joint",
    "JointCoupling",
    "Planar",
    "PointOnCurve",
    "PointOnPlane",
    "Prismatic",
    "Revolute",
    "Sine",
    "SmoothStep",
    "Spherical",
    "Universal",
]
