"""Integration in time: integrators of one contract, with phases and their events, forwards and backwards."""

from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.phase import Phase
from torchmbd.integrate.registry import METHODS
from torchmbd.results.motion_data import Moment, Switch
from torchmbd.results.trajectory import Trajectory

__all__ = ["METHODS", "Event", "Moment", "Phase", "Switch", "Trajectory"]
