"""Design: responses with gradients, the design space, the optimization problem."""

from torchmbd.design.angle import Angle
from torchmbd.design.constraint_rows import AtPeaks, AtTimes
from torchmbd.design.functions import history, measure
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
from torchmbd.design.problem import Problem
from torchmbd.design.response import Constraint, History, Measure
from torchmbd.design.responses import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.design.space import DesignSpace
from torchmbd.design.tradeoff import Tradeoff
from torchmbd.design.weighted import WeightedSum

__all__ = [
    "COMBINATORS",
    "OF_DESIGN",
    "RESPONSES",
    "RMS",
    "Acceleration",
    "Angle",
    "AtPeaks",
    "AtTime",
    "AtTimes",
    "Constraint",
    "DesignSpace",
    "Displacement",
    "Final",
    "Frequency",
    "History",
    "Integral",
    "Mass",
    "Max",
    "Mean",
    "MeanFrequency",
    "Measure",
    "Min",
    "PlyFailure",
    "PlyStress",
    "Position",
    "Problem",
    "Reaction",
    "RelativeDisplacement",
    "SmoothMax",
    "StrainEnergy",
    "Tradeoff",
    "Velocity",
    "WeightedSum",
    "history",
    "measure",
]  # fmt: skip
