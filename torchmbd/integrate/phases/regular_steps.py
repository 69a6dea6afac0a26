"""Regular steps of the lanes in one phase, many at a time, and the states at their ends.

Checked in tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from torch import Tensor

from torchmbd.integrate.integrator import Stepper
from torchmbd.math.pair import Pair
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import Record
from torchmbd.results.state import State


class RegularSteps:
    """Steps of lanes (a mask) from the point `first` of the grid to the point `last`, from states x, by a stepper.

    end      the last states;  states: those at all points, of the dynamics of the steps
    before   the steps before these
    into     the record of all points of the grid that takes the states; None: one of these steps
    """

    def __init__(
        self,
        stepper: Stepper,
        dynamics: Dynamics,
        times: Tensor,
        first: int,
        last: int,
        x: State,
        lanes: Tensor,
        before: RegularSteps | None,
        into: Record | None,
    ):
        self.stepper, self.first, self.x, self.before = stepper, first, x, before
        if before is not None:
            before.before = None  # of what was, the last point but one is asked for at most
        record, begin = (Record(x, last - first + 1), 0) if into is None else (into, first)
        record.put(begin, x)
        schedule = dynamics.topology.schedule(times[first + 1 : last + 1], dynamics.data)
        stepper.counts = lanes
        self.end = stepper.run(x, schedule, record, first, begin + 1)
        self.states = record.history().at(slice(begin, begin + last - first + 1))

    def state(self, k: int) -> State:
        """The state at the point k of the grid, or at the one before the first."""
        if k < self.first:
            return self.state(self.first) if self.before is None else self.before.state(k)
        q, v, vd, lam = (Pair(x[k - self.first]) if x.shape[-2] > 1 else x[k - self.first] for x in self.states.states)
        return State(q, v, vd, self.stepper.algorithmic(self.x.a, self.states.vd[: k - self.first + 1]), lam)
