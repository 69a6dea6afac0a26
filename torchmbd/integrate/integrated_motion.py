"""What integrations of `Motion` share, in forward and in reverse mode: how a motion is integrated, and what it has then.

Checked in tests/integrate/test_motion.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrator import Integrator, Steps
from torchmbd.integrate.lane_status import validity
from torchmbd.integrate.memory import require_memory
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.outputs import Outputs
from torchmbd.integrate.retries import LaneResults, integrate_lanes
from torchmbd.integrate.step_count import choose_steps
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.multibody.saddle.rank import Rank
from torchmbd.multibody.system import Dynamics, System
from torchmbd.results.history import History
from torchmbd.results.motion_data import Switch


@dataclass(eq=False, kw_only=True)
class IntegratedMotion:
    """A motion over a duration [s] by an integrator.

    names      of the inputs
    steps      their number; None: chosen from the data
    system     the mechanism, with the locks of its phases, or None where steps are given
    backend    of the steps, as in `simulate`

    Once it has run: the problem, dynamics of the whole system, results and validity of all lanes, outputs.
    """

    names: tuple[str, ...]
    duration: float
    steps: int | None
    system: System | None
    integrator: Integrator
    backend: str = "auto"
    problem: InitialValueProblem = field(init=False, repr=False)
    dynamics: Dynamics = field(init=False)
    results: LaneResults = field(init=False)
    validity: Tensor = field(init=False)
    outputs: Outputs = field(init=False)

    def integrate(self, problem: InitialValueProblem, tangents: int) -> None:
        """Integrate all lanes, with so many tangents."""
        first = None
        if self.steps is None:

            def check_memory(steps: int) -> None:
                assert self.system is not None
                require_memory(self.system, problem.dynamics.lanes, self.integrator.stored_intervals(steps), tangents)

            self.steps, first = choose_steps(self.integrator, problem.values(), check_memory)
            first = None if problem.dynamics.tangents else first  # a motion of values alone has no tangents
        self.results = integrate_lanes(self.integrator, problem, self.steps, first)
        self.dynamics = problem.dynamics if self.results.data is None else problem.dynamics.with_data(self.results.data)
        self.validity = validity(self.history, self.status, self.results.statistics)

    def of_sound_lanes(self, x: Tensor) -> Tensor:
        """Derivatives [..., lanes], zero of lanes that have failed."""
        return torch.where(self.validity[1] > 0.0, x, 0.0)

    @property
    def history(self) -> History:
        """States of all lanes."""
        return self.results.history

    @property
    def has_checkpoints(self) -> bool:
        """Return True where there are steps between the states that are kept."""
        return isinstance(self.integrator, OneStep) and self.integrator.checkpoint > 1

    @torch.no_grad()
    def at_all_steps(self, lane: int) -> History | None:
        """The states of one lane at all its steps, made again by the integrator that made them; None: all were kept."""
        if not self.has_checkpoints:
            return None
        by = self.results.replaced.get(lane, Steps(self.integrator, 1))
        assert self.steps is not None
        problem = self.problem.values().select_lanes([lane])
        return problem.integrate(replace(by.integrator, checkpoint=1), by.substeps * self.steps).history

    @property
    def ranks(self) -> list[Rank]:
        """The rank of the constraints that act, for each part of the motion."""
        if self.history.segment is None:
            return [self.dynamics.rank]
        return [record.dynamics.rank for record in self.history.run.records]

    def rows_at(self, lane: int, t: float) -> list[int]:
        """The constraint rows that act on a lane at a time [s]."""
        return self.problem.segments[sum(float(switch.t[lane]) <= t for switch in self.switches)].rows

    @property
    def status(self) -> list[str]:
        """Of all lanes."""
        return self.results.status

    @property
    def switches(self) -> list[Switch]:
        """Between segments, without a graph of torch."""
        return self.results.switches

    @cached_property
    def stats(self) -> dict[str, Any]:
        """Statistics of the steps by name; the motion adds its own."""
        return self.results.statistics.numbers()

    def expansion(self, data: dict[str, Any]) -> Expansion | None:
        """Leads from the condensed to the whole system, as a function of the data; None: it is the whole."""
        return self.history.expansion_by(data)

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor:
        """All multipliers [times, rows, pair, lanes]; of redundant rows those of least norm."""
        if self.history.segment is not None:
            return self.history.run.multipliers(history, data)
        return history.least_norm_multipliers(self.dynamics.least_norm, self.duration, data)
