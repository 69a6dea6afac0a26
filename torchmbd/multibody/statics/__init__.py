"""Bodies under static loads: buckling."""

from torchmbd.multibody.statics.buckling import Buckling, BucklingCase, buckling

__all__ = ["Buckling", "BucklingCase", "buckling"]
