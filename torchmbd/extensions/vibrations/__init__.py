"""Small vibrations of a whole machine about rest, steady rotation or a motion: eigenvalues, linear systems, measures."""

from torchmbd.extensions.vibrations.campbell_diagram import Campbell, campbell
from torchmbd.extensions.vibrations.frozen_poles import frozen_poles
from torchmbd.extensions.vibrations.linear_system import LinearSystem, linearize
from torchmbd.extensions.vibrations.measures.critical_values import CriticalSpeed, StabilityLimit
from torchmbd.extensions.vibrations.measures.frequency_response import FrequencyResponse
from torchmbd.extensions.vibrations.measures.system_vibrations import (
    CampbellClearance,
    DampingRatio,
    StabilityMargin,
    SystemFrequency,
)

__all__ = [
    "Campbell",
    "CampbellClearance",
    "CriticalSpeed",
    "DampingRatio",
    "FrequencyResponse",
    "LinearSystem",
    "StabilityLimit",
    "StabilityMargin",
    "SystemFrequency",
    "campbell",
    "frozen_poles",
    "linearize",
]
