"""System: topology, equations of motion, saddle-point matrix, initial conditions, and the frozen Dynamics."""

from torchmbd.system.dynamics import Dynamics
from torchmbd.system.system import System

__all__ = ["Dynamics", "System"]
