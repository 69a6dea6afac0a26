"""What is known of the errors of equal steps, of one segment or of several, from their states as they come.

Checked in tests/integrate/test_simulate.py, tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.integrate.estimates import StepErrors, alternating_share, alternations, second_halves, turns
from torchmbd.integrate.statistics import Statistics
from torchmbd.integrate.stepper import TURN, IterationErrors, first_true
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History


class StepEstimates:
    """Of steps of size duration / steps [s].

    dynamics   of the states;  constant: of the error of a step, as of StepErrors
    """

    def __init__(self, dynamics: Dynamics, constant: float, duration: float, steps: int):
        self.dynamics, self.duration, self.steps, self.h = dynamics, duration, steps, duration / steps
        self.errors = StepErrors(dynamics, constant, self.h)
        self.iterations = IterationErrors(dynamics.lanes, duration, self.h)
        self.turn = torch.zeros(steps + 1, dynamics.lanes, dtype=torch.float64)
        self.alternation: Tensor | None = None
        if dynamics.topology.beams is not None:
            self.alternation = torch.zeros(2, steps + 1, dynamics.lanes, dtype=torch.float64)

    def update(self, first: int, states: History, errors: Tensor, counted: Tensor | None = None) -> None:
        """Go on with states at the times of number `first` and those after it, and the errors of the iterations between these.

        states    the first was the last before, but where a segment begins
        errors    [lanes, times - 1]
        counted   which lanes have states [times, lanes]; None: all
        """
        smooth = None
        if counted is not None:
            q, v, vd, lam = (torch.where(counted[:, None, None], x[:, :, :1], 0.0) for x in states.states)
            states, smooth = History(q, v, vd, lam), counted[1:] & counted[:-1]
        end = first + len(states.q)
        self.iterations.update(first, states, errors)
        self.errors.update(states, smooth)
        turn = turns(self.dynamics, states, self.h)
        self.turn[first:end] = turn if counted is None else torch.where(counted, turn, self.turn[first:end])
        if self.alternation is not None and len(states.q) > 2:
            inner, share = slice(first + 1, end - 1), alternations(self.dynamics, states)
            if smooth is not None:
                share = torch.where(smooth[1:] & smooth[:-1], share, self.alternation[:, inner])
            self.alternation[:, inner] = share

    def put_into(self, statistics: Statistics, segment: Tensor | None = None, every: int = 1) -> None:
        """Of all lanes.

        segment  number of that of each time [times, lanes], None: there is one
        every    steps between two states that are kept
        """
        statistics.steps, statistics.step_size, statistics.turn = self.steps, self.h, self.turn.amax(0)
        self.errors.put_into(statistics, self.steps)
        self.iterations.put_into(statistics, self.steps + 1)
        if self.alternation is not None:
            number = torch.zeros(self.steps + 1, 1, dtype=torch.long) if segment is None else segment
            statistics.alternation = alternating_share(self.alternation[:, 1:-1], second_halves(number))
        assert statistics.valid_times is not None
        valid = statistics.valid_times.minimum(first_true(self.turn > TURN).clamp_min(1))
        statistics.valid_times = (valid + every - 1) // every
