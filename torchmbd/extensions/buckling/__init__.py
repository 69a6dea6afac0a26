"""Buckling of bodies under static loads, and under those of a motion.

>>> factor = mbd.buckling.BucklingFactor("column", loads={"end": (-1000.0, 0.0, 0.0)})  # of 1 kN along the column
"""

from torchmbd.extensions.buckling.buckling import BucklingModes, linear_buckling
from torchmbd.extensions.buckling.buckling_factor import BucklingFactor
from torchmbd.extensions.buckling.buckling_index import BucklingIndex

__all__ = ["BucklingFactor", "BucklingIndex", "BucklingModes", "linear_buckling"]


def __dir__() -> list[str]:
    return [*__all__]
