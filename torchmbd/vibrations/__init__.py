"""States at rest and in steady rotation, and small vibrations about them: eigenvalues over speeds, linear systems."""

from torchmbd.vibrations.campbell_diagram import Campbell, campbell
from torchmbd.vibrations.frozen_poles import frozen_poles
from torchmbd.vibrations.linear_system import LinearSystem, linearize
from torchmbd.vibrations.statics import Equilibrium, equilibrium

__all__ = ["Campbell", "Equilibrium", "LinearSystem", "campbell", "equilibrium", "frozen_poles", "linearize"]
