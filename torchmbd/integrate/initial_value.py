"""What is integrated: an initial value problem of some lanes over a duration, by any number of equal steps.

    OneSegment        a motion without switches
    SeveralSegments   a motion through phases (phases/multiphase.py)

retries.py integrates either, and lanes of it again.
Checked in tests/integrate/test_simulate.py, tests/contracts/test_segments.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

from torchmbd.integrate.integrator import IntegrationResult, Integrator
from torchmbd.integrate.jumps import held_times_of
from torchmbd.multibody.system.dynamics import Dynamics


class InitialValueProblem(Protocol):
    """See the module header.

    dynamics   of the whole system;  duration [s]
    """

    dynamics: Dynamics
    duration: float

    def integrate(self, integrator: Integrator, steps: int) -> IntegrationResult:
        """States of all lanes at steps + 1 equal times, with tangents where the dynamics have any."""
        ...

    def select_lanes(self, lanes: Sequence[int]) -> Self:
        """The same of some lanes."""
        ...

    def values(self) -> Self:
        """The same without tangents."""
        ...

    def held_times(self) -> list[float]:
        """Times within segments at which held values of a controller change [s]."""
        ...

    def rows_at_end(self, result: IntegrationResult, lane: int) -> list[int]:
        """The constraint rows that act when the motion of a lane ends."""
        ...


@dataclass(frozen=True)
class OneSegment(InitialValueProblem):
    """A motion without switches."""

    dynamics: Dynamics
    duration: float

    def integrate(self, integrator: Integrator, steps: int) -> IntegrationResult:
        return integrator.integrate(self.dynamics, self.duration, steps)

    def select_lanes(self, lanes: Sequence[int]) -> OneSegment:
        return OneSegment(self.dynamics.select_lanes(lanes), self.duration)

    def values(self) -> OneSegment:
        return OneSegment(self.dynamics.values(), self.duration) if self.dynamics.tangents else self

    def held_times(self) -> list[float]:
        return held_times_of(self.dynamics, self.duration)

    def rows_at_end(self, result: IntegrationResult, lane: int) -> list[int]:
        """See InitialValueProblem. All rows act throughout."""
        return list(range(self.dynamics.topology.rows))
