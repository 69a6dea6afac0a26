"""Regular steps whose size moves with the duration T of the motion: h = T / n, t_i = i T / n, each a number with tangents.

They are steps of their own sizes (`Integrator.step_of_size`), iterated to rounding.
Checked in tests/sensitivity/test_phase_times.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from torchmbd.integrate.integrator import Stepper
from torchmbd.integrate.step import algorithmic
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.topology import Schedule
from torchmbd.results.history import Record
from torchmbd.results.state import State


class MovingSteps(Stepper):
    """Steps whose sizes depend on the design; time(i): the time [1 + n, lanes] at the end of step i."""

    def __init__(self, integrator: Any, dynamics: Dynamics, time: Callable[[int], Any]):
        super().__init__(dynamics)
        self.integrator, self.time = integrator, time

    def run(self, x: State, schedule: Schedule, record: Record, first: int = 0, start: int = 1) -> State:
        """See Stepper. The schedule counts steps only: laws are evaluated at times that depend on the design."""
        self.steps = len(schedule)  # the last ones
        for k in range(len(schedule)):
            begin, end = self.time(first + k - 1), self.time(first + k)
            x = self.integrator.step_of_size(self.dynamics, x, end - begin, end)
            record.put(start + k, x)
        return x

    def algorithmic(self, a: Any, vd: Tensor) -> Any:
        return algorithmic(self.integrator.weights(1.0), a, vd)
