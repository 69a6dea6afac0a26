"""System: topology, equations of motion, saddle-point matrix, initial conditions, and the frozen Dynamics."""

from torchmbd.multibody.system.description import Description
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.equilibrium import Equilibrium, equilibrium
from torchmbd.multibody.system.system import System

__all__ = ["Description", "Dynamics", "Equilibrium", "System", "equilibrium"]
