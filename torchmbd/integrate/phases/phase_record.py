"""The record of one phase: where its lanes entered, which steps they made, where they left it.

Checked in tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.lanes import pick_lanes, pick_states
from torchmbd.integrate.smooth_start import SmoothStart
from torchmbd.math.pair import linear, value
from torchmbd.multibody.saddle.condensation import Condensation
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


class PhaseExit(NamedTuple):
    """Times t [1 + n_b, lanes] at which lanes leave a phase (inf: a lane that does not), and their states then."""

    t: Any
    x: State

    def lanes(self, lanes: Sequence[int]) -> PhaseExit:
        """Return the part of some lanes."""
        return PhaseExit(pick_lanes(self.t, lanes), pick_states(self.x, lanes))


@dataclass
class PhaseRecord:
    """The steps of all lanes in one phase, for the adjoint (adjoint.py).

    dynamics    of the phase, with the marks of its locks;  condensed: of its regular steps
    entry       time and state before the switch that begins the phase;  start: the state after it
    first       the first point of the grid that a lane steps to [lanes]
    on_grid     whether the state there is `start` itself [lanes]
    start_of_steps  `start` as a condensed state
    goes_on     whether regular steps go on as if there were no switch: it changes nothing, and one of them ends there [lanes]
    arrival     the condensed state there, from which regular steps go on, of lanes that get there
    exit        where lanes left the phase, with the multipliers of retained rows;  has_exit: which did [lanes]
    base_point  the point of the grid at which their last step begins (-1: at `start`) [lanes]
    base        the condensed state there
    ends_on_grid  whether this step is a regular one, whatever the design [lanes]
    checkpoints  algorithmic accelerations [n_v, 1, lanes] at points of the grid from which steps can be made again
    restarts    points at which lanes arrived, and the stepper discarded what it keeps of all lanes
    """

    number: int
    dynamics: Dynamics
    condensed: Dynamics
    entry: PhaseExit
    start: State
    start_of_steps: State
    first: Tensor
    on_grid: Tensor
    goes_on: Tensor
    checkpoints: dict[int, Tensor] = field(default_factory=dict)
    restarts: list[int] = field(default_factory=list)
    arrival: State = field(init=False)
    exit: PhaseExit = field(init=False)
    base: State = field(init=False)

    def __post_init__(self) -> None:
        self.arrival = self.base = self.start_of_steps
        never = linear(torch.zeros_like, self.entry.t)
        self.exit = PhaseExit(never + torch.full_like(value(never), torch.inf), self.start._replace(lam=self.base.lam))
        self.has_exit, self.ends_on_grid = torch.zeros_like(self.on_grid), torch.zeros_like(self.on_grid)
        self.base_point = torch.full_like(self.first, -1)

    @property
    def condensation(self) -> Condensation | None:
        """Of the regular steps; None: they are those of the whole system."""
        return None if self.condensed is self.dynamics else self.condensed.initial.condensation

    def smooth_start(self, integrator: Integrator, dynamics: Dynamics, x: State, t: Any, h: Any) -> SmoothStart:
        """Return the smooth start of condensed states x of some lanes at times t (Integrator.smooth_start).

        dynamics   of these lanes;  h: sizes of regular steps [1 + n, lanes]
        """
        start, c = integrator.smooth_start(dynamics, self.whole(x, t), t, h), self.condensation
        return start if c is None else start.map(lambda y: y.index_select(0, c.independent))

    def condensed_of(self, dynamics: Dynamics) -> Dynamics:
        """The dynamics of the regular steps, of some lanes with other data."""
        return dynamics if self.condensation is None else dynamics.condensed().share_rank(self.condensed)

    def retained(self, x: State) -> State:
        """The state of the condensed system, out of that of the whole one."""
        return x if self.condensation is None else self.condensation.retained_state(x)

    def whole(self, x: State, t: Any) -> State:
        """The state of the whole system at t [s] (Condensation.whole_state), out of that of the condensed one."""
        return x if self.condensation is None else self.condensation.whole_state(x, t)
