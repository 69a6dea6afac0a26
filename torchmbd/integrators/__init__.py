"""Integrators: torchdiffeq and generalized-alpha behind one door, with sensitivities."""

from torchmbd.integrators.simulate import METHODS, simulate
from torchmbd.integrators.trajectory import Trajectory

__all__ = ["METHODS", "Trajectory", "simulate"]
