"""Bodies: ground, rigid, flexible, and the frames on them."""

from torchmbd.bodies.flexible import FlexibleBody
from torchmbd.bodies.frame import Frame
from torchmbd.bodies.rigid import Ground, RigidBody

__all__ = ["FlexibleBody", "Frame", "Ground", "RigidBody"]
