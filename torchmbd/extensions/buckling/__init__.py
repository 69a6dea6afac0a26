"""Buckling of bodies under static loads, and under those of a motion."""

from torchmbd.extensions.buckling.buckling import Buckling, buckling
from torchmbd.extensions.buckling.buckling_factor import BucklingFactor
from torchmbd.extensions.buckling.buckling_index import BucklingIndex

__all__ = ["Buckling", "BucklingFactor", "BucklingIndex", "buckling"]
