"""Integrators: torchdiffeq and generalized-alpha by one contract, with sensitivities."""

from torchmbd.integrate.phase import Phase
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.registry import METHODS
from torchmbd.integrate.simulate import simulate
from torchmbd.results.motion_data import Moment, Switch
from torchmbd.results.trajectory import Trajectory

__all__ = ["METHODS", "Event", "Moment", "Phase", "Switch", "Trajectory", "simulate"]
