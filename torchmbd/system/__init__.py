"""System: topology, equations of motion, saddle-point matrix, initial conditions, and the frozen Dynamics."""

from torchmbd.system.description import Description
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.equilibrium import Equilibrium, equilibrium
from torchmbd.system.system import System

__all__ = ["Description", "Dynamics", "Equilibrium", "System", "equilibrium"]
