"""The registries of responses: names as experiment files spell them.

RESPONSES     histories of a motion
COMBINATORS   measures of a history
OF_DESIGN     measures that take no history

A new response is one small class (response.py) and one line here, or in the table of extensions (registry.py); the contract
test runs over these.
"""

from __future__ import annotations

from torchmbd.design.angle import Angle
from torchmbd.design.constraint_rows import AtPeaks, AtTimes
from torchmbd.design.histories import (
    Acceleration,
    Displacement,
    Position,
    Reaction,
    RelativeDisplacement,
    StrainEnergy,
    Velocity,
)
from torchmbd.design.measures import (
    RMS,
    AtTime,
    Final,
    Frequency,
    Integral,
    Mass,
    Max,
    Mean,
    MeanFrequency,
    Min,
    SmoothMax,
)
from torchmbd.design.ply_failure import PlyFailure, PlyStress
from torchmbd.design.response import History, Measure
from torchmbd.registry import Registry

RESPONSES: Registry[type[History]] = Registry(
    "responses",
    {
        "strain_energy": StrainEnergy,
        "position": Position,
        "displacement": Displacement,
        "velocity": Velocity,
        "acceleration": Acceleration,
        "relative_displacement": RelativeDisplacement,
        "reaction": Reaction,
        "angle": Angle,
        "ply_failure": PlyFailure,
        "ply_stress": PlyStress,
    },
)
COMBINATORS: Registry[type[Measure]] = Registry(
    "combinators",
    {
        "integral": Integral,
        "mean": Mean,
        "rms": RMS,
        "max": Max,
        "min": Min,
        "smooth_max": SmoothMax,
        "at_time": AtTime,
        "final": Final,
        "at_times": AtTimes,
        "at_peaks": AtPeaks,
    },
)
OF_DESIGN: Registry[type[Measure]] = Registry(
    "of_design",
    {
        "frequency": Frequency,
        "mean_frequency": MeanFrequency,
        "mass": Mass,
    },
)
