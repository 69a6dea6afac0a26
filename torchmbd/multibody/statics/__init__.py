"""Bodies on supports: buckling under static loads, and natural frequencies."""

from torchmbd.multibody.statics.buckling import Buckling, BucklingCase, buckling
from torchmbd.multibody.statics.buckling_series import BucklingSeries
from torchmbd.multibody.statics.unit_loads import UnitLoads
from torchmbd.multibody.statics.vibrations import VibrationCase, Vibrations, frequencies

__all__ = [
    "Buckling",
    "BucklingCase",
    "BucklingSeries",
    "UnitLoads",
    "VibrationCase",
    "Vibrations",
    "buckling",
    "frequencies",
]
