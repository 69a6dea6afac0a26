"""System: bodies, joints and forces together, their structure stage, the frozen Dynamics, and a description."""

from torchmbd.multibody.system.description import Description
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.split import Chain, split
from torchmbd.multibody.system.system import System

__all__ = ["Chain", "Description", "Dynamics", "System", "split"]
