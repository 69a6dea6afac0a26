"""A motion through phases as an initial value problem.

Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrator import IntegrationResult, Integrator
from torchmbd.integrate.jumps import held_times_of, within_phases
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.lanes import lanes_of
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.segment import Segment
from torchmbd.multibody.system import Dynamics


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
        statistics = integrator.integrate_phases(run)
        failed = {lane: reason for lane, reason in enumerate(run.failures) if reason}
        contacts = run.watch.unresolved(self.duration / steps, by_steps=integrator.adjoint)
        run.watch.gaps_and_rates = None  # of all steps: the run is kept for the adjoint
        return IntegrationResult(
            run.history, statistics, failed, contacts, run.doubts, run.failed_for_good, run.switches, run.whole.data
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
