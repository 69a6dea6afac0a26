"""Bodies: ground, rigid, flexible, and the frames on them."""

from torchmbd.multibody.bodies.flexible import FlexibleBody
from torchmbd.multibody.bodies.flexible_beam import FlexibleBeam
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.bodies.interfaces import Interface
from torchmbd.multibody.bodies.rigid import Ground, RigidBody

__all__ = ["FlexibleBeam", "FlexibleBody", "Frame", "Ground", "Interface", "RigidBody"]
