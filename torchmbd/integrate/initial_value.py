"""What is integrated: an initial value problem of some lanes over a duration, by any number of equal steps.

    OneSegment        a motion without switches
    SeveralSegments   a motion through phases (phases/loop.py)

retries.py integrates either, and lanes of it again.
Checked in tests/integrate/test_simulate.py, tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py,
tests/contracts/test_segments.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

from torchmbd.integrate.integrator import IntegrationResult, Integrator
from torchmbd.integrate.jumps import held_times_of, within_phases
from torchmbd.integrate.lanes import lanes_of
from torchmbd.integrate.phases import loop
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.segment import Segment
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


@dataclass(frozen=True)
class SeveralSegments(InitialValueProblem):
    """The motion of some lanes through phases.

    dynamics   of the whole system, with all joints and locks
    """

    dynamics: Dynamics
    segments: list[Segment]
    views: Views
    duration: float

    def integrate(self, integrator: Integrator, steps: int) -> IntegrationResult:
        every = steps // integrator.stored_intervals(steps)
        run = MultiphaseRun(self.dynamics, self.segments, self.views, self.duration, steps, integrator, every)
        statistics = loop.integrate(run)
        contacts = run.watch.unresolved(self.duration / steps, by_steps=integrator.adjoint)
        run.watch.gaps_and_rates = None  # of all steps: the run is kept for the adjoint
        return IntegrationResult(
            history=run.history,
            statistics=statistics,
            failed={lane: reason for lane, reason in enumerate(run.failures) if reason},
            contacts=contacts,
            doubts=run.doubts,
            for_good=run.failed_for_good,
            switches=run.switches,
            data=run.whole.data,
        )

    def select_lanes(self, lanes: Sequence[int]) -> SeveralSegments:
        dynamics = lanes_of(self.dynamics, lanes)
        if dynamics is self.dynamics:
            return self
        return replace(self, dynamics=dynamics, views=self.views.select_lanes(lanes, dynamics))

    def values(self) -> SeveralSegments:
        if not self.dynamics.tangents:
            return self
        values = self.dynamics.values()
        return replace(self, dynamics=values, views=self.views.values(values))

    def held_times(self) -> list[float]:
        phases = [segment.phase for segment in self.segments]
        return within_phases(held_times_of(self.dynamics, self.duration), phases, self.duration)

    def rows_at_end(self, result: IntegrationResult, lane: int) -> list[int]:
        assert result.history.segment is not None
        number = int(result.history.segment[-1, 0, lane])
        return self.segments[number].rows if number >= 0 else []
