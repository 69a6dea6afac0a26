"""Small vibrations of a whole machine about rest, steady rotation or a motion: eigenvalues, linear systems, measures.

>>> round(mbd.vibrations.campbell(mbd.examples.pendulum(length=2.0), [0.0], modes=1).frequencies.item(), 4)  # [Hz]
0.3525
"""

from torchmbd.extensions.vibrations.campbell_diagram import CampbellDiagram, campbell
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
    "CampbellClearance",
    "CampbellDiagram",
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


def __dir__() -> list[str]:
    return [*__all__]
