"""System: topology, equations of motion, saddle-point matrix, initial conditions, and the frozen Dynamics."""

from torchmbd.multibody.system.description import Description
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.split import Chain, split
from torchmbd.multibody.system.start import Start
from torchmbd.multibody.system.system import System

__all__ = ["Chain", "Description", "Dynamics", "Start", "System", "split"]
