"""Bodies under static loads: buckling."""

from torchmbd.multibody.statics.buckling import Buckling, BucklingCase, buckling
from torchmbd.multibody.statics.buckling_series import BucklingSeries
from torchmbd.multibody.statics.unit_loads import UnitLoads

__all__ = ["Buckling", "BucklingCase", "BucklingSeries", "UnitLoads", "buckling"]
