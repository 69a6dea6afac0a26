"""Design: responses with gradients, the design space, the optimization problem."""

from torchmbd.design.problem import Problem
from torchmbd.design.response import Constraint, History, Measure
from torchmbd.design.responses import COMBINATORS, RESPONSES, Integral, Max, StrainEnergy
from torchmbd.design.space import DesignSpace

__all__ = [
    "COMBINATORS", "RESPONSES", "Constraint", "DesignSpace", "History", "Integral", "Max", "Measure", "Problem", "StrainEnergy",
]  # fmt: skip
