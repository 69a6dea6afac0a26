"""What is integrated: an initial value problem of some lanes through segments, by any number of equal steps (phases/loop.py).

retries.py integrates lanes of it again.
Checked in tests/integrate/test_simulate.py, tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py,
tests/contracts/test_segments.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from torchmbd.integrate.held_times import held_times_of, within_phases
from torchmbd.integrate.integrator import IntegrationResult, Integrator
from torchmbd.integrate.lanes import lanes_of
from torchmbd.integrate.phases import loop
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.phases.segment import Segment, keep_equations, single_segment
from torchmbd.multibody.start.start import EquilibriumConditions
from torchmbd.multibody.system.dynamics import Dynamics


@dataclass(frozen=True)
class InitialValueProblem:
    """The motion of some lanes over a duration [s].

    dynamics   of the whole system, with all joints and locks
    views      what events and impacts read; of other segments nothing
    """

    dynamics: Dynamics
    segments: Sequence[Segment]
    views: Views
    duration: float

    @classmethod
    def of_dynamics(cls, dynamics: Dynamics, duration: float) -> InitialValueProblem:
        """In one segment, in which all joints and laws act."""
        return cls(dynamics, single_segment(dynamics), Views.of(None, dynamics, {}), duration)

    @property
    def keeps_equations(self) -> bool:
        """True if all joints and laws act in every segment."""
        return keep_equations(self.segments, self.dynamics.topology)

    @property
    def closed_start(self) -> tuple[Any, Any]:
        """Initial q [n_q, pair, lanes] and v [n_v, pair, lanes], in which the joints of the first segment are closed.

        Marks of locks are set when their phase begins. So neither locks nor joints of later segments close the mechanism.
        """
        segment = self.segments[0]
        topology, saddle = segment.closing
        if topology is self.dynamics.topology:
            return self.dynamics.start
        free = replace(self.dynamics, topology=topology, saddle=saddle, initial=segment.initial)
        # A mechanism without its locks may have no equilibrium.
        sags_in_locks = segment.locks and isinstance(segment.initial, EquilibriumConditions)
        return segment.initial.assembled(free) if sags_in_locks else free.start

    def integrate(self, integrator: Integrator, steps: int) -> IntegrationResult:
        """States of all lanes at steps + 1 equal times, with tangents where the dynamics have any."""
        every = steps // integrator.stored_intervals(steps)
        run = MultiphaseRun(self.dynamics, self.segments, self.views, self.duration, steps, integrator, every)
        statistics = loop.integrate(run)
        contacts = run.watch.unresolved(self.duration / steps, by_steps=integrator.adjoint)
        run.watch.gaps_and_rates = None  # of all steps: the run is kept for the adjoint
        return IntegrationResult(
            history=run.history,
            statistics=statistics,
            sizes=run.recorded.sizes,
            failed={lane: reason for lane, reason in enumerate(run.failures) if reason},
            contacts=contacts,
            doubts=run.doubts,
            for_good=run.failed_for_good,
            switches=run.switches,
            data=run.whole.data if any(segment.locks for segment in self.segments) else None,
        )

    def select_lanes(self, lanes: Sequence[int]) -> InitialValueProblem:
        """The same of some lanes."""
        dynamics = lanes_of(self.dynamics, lanes)
        if dynamics is self.dynamics:
            return self
        return replace(self, dynamics=dynamics, views=self.views.select_lanes(lanes, dynamics))

    def values(self) -> InitialValueProblem:
        """The same without tangents."""
        if not self.dynamics.tangents:
            return self
        values = self.dynamics.values()
        return replace(self, dynamics=values, views=self.views.values(values))

    def held_times(self) -> list[float]:
        """Times within segments at which held values of a controller change [s]."""
        phases = [segment.phase for segment in self.segments]
        return within_phases(held_times_of(self.dynamics, self.duration), phases, self.duration)

    def rows_at_end(self, result: IntegrationResult, lane: int) -> list[int]:
        """The constraint rows that act when the motion of a lane ends."""
        if result.history.segment is None:
            return self.segments[0].rows
        number = int(result.history.segment[-1, 0, lane])
        return self.segments[number].rows if number >= 0 else []
