"""Integrators: torchdiffeq and generalized-alpha by one contract, with sensitivities."""

from torchmbd.integrate.campbell_diagram import Campbell, campbell
from torchmbd.integrate.linear_system import LinearSystem, linearize
from torchmbd.integrate.phase import Phase
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.registry import METHODS
from torchmbd.integrate.simulate import simulate
from torchmbd.integrate.statics import Equilibrium, equilibrium
from torchmbd.results.motion_data import Moment, Switch
from torchmbd.results.trajectory import Trajectory

__all__ = [
    "METHODS", "Campbell", "Equilibrium", "Event", "LinearSystem", "Moment", "Phase", "Switch", "Trajectory", "campbell",
    "equilibrium", "linearize",
    "simulate",
]  # fmt: skip
