"""Motions: `simulate` in time and `equilibrium` at rest, both with sensitivities, and a `Simulation` that is prepared once."""

from torchmbd.simulation.equilibrium import Equilibrium, equilibrium
from torchmbd.simulation.simulate import simulate
from torchmbd.simulation.simulation import Simulation

__all__ = ["Equilibrium", "Simulation", "equilibrium", "simulate"]
