"""Integrators: torchdiffeq and generalized-alpha behind one door, with sensitivities."""

from torchmbd.integrators.events import Event
from torchmbd.integrators.phases import Phase
from torchmbd.integrators.registry import METHODS
from torchmbd.integrators.simulate import simulate
from torchmbd.integrators.trajectory import Moment, Switch, Trajectory

__all__ = ["METHODS", "Event", "Moment", "Phase", "Switch", "Trajectory", "simulate"]
