"""Motions: `simulate` in time, by integrators of one contract, and `equilibrium` at rest, both with sensitivities."""

from torchmbd.integrate.equilibrium import Equilibrium, equilibrium
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.phase import Phase
from torchmbd.integrate.registry import METHODS
from torchmbd.integrate.simulate import simulate
from torchmbd.integrate.simulation import Simulation
from torchmbd.results.motion_data import Moment, Switch
from torchmbd.results.trajectory import Trajectory

__all__ = [
    "METHODS",
    "Equilibrium",
    "Event",
    "Moment",
    "Phase",
    "Simulation",
    "Switch",
    "Trajectory",
    "equilibrium",
    "simulate",
]
