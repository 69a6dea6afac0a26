"""Events: the first time at which a function of the motion passes zero, and its derivatives.

    g(t*, x(t*, b)) = 0        dt*/db = -g_b / g_t        both total derivatives along the motion

g is a function: motion -> [lanes, times], written as for a history; here the motion has one time only. torch differentiates g
in reverse mode by all that it may depend on: time, state, data of the model, designs and mode shapes. Where these have
tangents, so has g. Lanes that are at different times are one motion, unless the function reads the time: then they go one by
one.

Accelerations and multipliers that g reads are those that the equations of motion determine from time, positions and rates.
Those of a step are others by an error of first order, which alternates from step to step and depends on the size of the
step (results/ringing.py): g would pass zero where the force does not, and at another time with each size.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.lanes import expanded, join_lanes, lanes_of, pick_lanes
from torchmbd.math.gradients import refuse_lost_gradients
from torchmbd.math.pair import Pair, value
from torchmbd.math.row_selection import select_rows
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.times_as_lanes import at_time, over_times
from torchmbd.multibody.equations.topology import Prescribed
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History
from torchmbd.results.mode_shapes import DesignShapes, GivenShapes, SomeLanes, shape_tangents
from torchmbd.results.motion_data import OK
from torchmbd.results.state import State
from torchmbd.results.time_rows import IntegratedSignals, Rows, Signals, TensorSignals
from torchmbd.results.trajectory import Trajectory
from torchmbd.results.turns import Turns

DIRECTIONS = {"falling": -1, "rising": 1, "either": 0}
ROUNDING = 1e-9  # of the function after a step: what it is where a phase begins at its zero


@dataclass(frozen=True)
class Event:
    """The time when a function of the motion passes zero; it ends a phase.

    function   motion -> [lanes, times], written with torch operations; or a history, such as Position("mass", "z"). The value
               at a time depends on the state at this time alone: `simulate` looks at one instant, or at several
    direction  "falling", "rising" or "either"

    >>> turn = mbd.Event(mbd.Velocity("bob", "x"), "falling")  # the pendulum stops at its highest point
    >>> phases = [mbd.Phase(until=turn), mbd.Phase()]
    >>> motion = mbd.simulate(mbd.examples.pendulum(speed=0.1), 1.0, steps=50, phases=phases)
    >>> round(motion.switches[0].t.item(), 3)  # a quarter of the period of 2.006 s
    0.502
    """

    function: Any
    direction: str = "either"

    def __post_init__(self) -> None:
        if not callable(self.function) and not hasattr(self.function, "values"):
            raise InputError(
                "function",
                self.function,
                "a function motion -> [lanes, times] or a history",
                noun="function of an event",
            )
        if getattr(self.function, "since_start", False):
            raise self._not_of_an_instant("is a change since the start of the motion")
        if not isinstance(self.direction, str) or self.direction not in DIRECTIONS:
            raise InputError("direction", self.direction, DIRECTIONS, noun="direction of an event")

    def of(self, motion: Trajectory) -> Tensor:
        """The function [lanes, times]; InputError if it returns anything else."""
        g = self.function.values(motion) if hasattr(self.function, "values") else self.function(motion)
        shape = (motion.lanes, motion.signals.times)
        if not isinstance(g, Tensor) or g.shape != shape:
            returned = f"shape {tuple(g.shape)}" if isinstance(g, Tensor) else repr(g)
            raise InputError(
                "function",
                allowed=f"must return a tensor [lanes, times], {shape}",
                state=f"returned {returned}",
                noun="the function of an event",
            )
        return g

    def _not_of_an_instant(self, state: str) -> InputError:
        return InputError(
            "function",
            self.function,
            "a function of the state at each time",
            "mbd.Position(...) minus a number, instead of a displacement since the start",
            state=state,
            noun="the function of an event",
        )

    def require_instants(self, in_motion: Tensor, alone: Tensor) -> None:
        """InputError if the value at a time of the motion depends on other times of the motion."""
        size = torch.maximum(in_motion.abs(), alone.abs())
        if bool(((in_motion - alone).abs() > ROUNDING * size).any()):
            raise self._not_of_an_instant("has values that depend on other times")

    def at_once(self, motion: Trajectory) -> Tensor:
        """The function [1, lanes] of a motion of one time."""
        return self.of(motion)[:, 0][None]

    def passed(self, before: Tensor, after: Tensor) -> Tensor:
        """True if the function passed zero between two values [lanes].

        A first value of the size of rounding does not count. A second value of this size counts as zero, so that an event at
        the end of a step belongs to this step and not to the next one.
        """
        sign, zero = DIRECTIONS[self.direction], ROUNDING * before.abs()
        falls, rises = (before > 0) & (after <= zero), (before < 0) & (after >= -zero)
        passed = (falls & (sign <= 0)) | (rises & (sign >= 0))
        return passed & (before.abs() > ROUNDING * after.abs())


class _TimeRead(Exception):
    """A function has read the time of a motion whose lanes are at different times."""


class _TimesOfLanes(Tensor):
    """The time of a motion whose lanes are at different times: there is none that they share."""

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise _TimeRead


class Instant(Signals):
    """Positions and rates of the states x at times t [1 + n, lanes] as a motion of one time; see the module header."""

    def __init__(self, dynamics: Dynamics, t: Any, x: State):
        super().__init__()
        self.dynamics, self.t, self.x = dynamics, t, x
        self.lanes, self.times = x.q.shape[-1], 1

    def _values(self, name: str, rows: Rows) -> Tensor:
        y = value(self._part(name))[:, 0].T[:, None]
        return y if rows is None else y[..., list(rows)]

    def _tangents(self, name: str, rows: Rows) -> Tensor | None:
        part = self._part(name)
        if not isinstance(part, Pair):
            return None
        y = part.tangent.permute(2, 0, 1)[:, None]
        return y if rows is None else y[..., list(rows), :]

    def _part(self, name: str) -> Any:
        if name in ("q", "v"):
            return self.x.q if name == "q" else self.x.v
        return self._solution[name == "lam"]

    @cached_property
    def _solution(self) -> tuple[Any, Any]:
        """Accelerations, and multipliers of all rows, of redundant ones those of least norm."""
        dynamics, t = self.dynamics, self.t.expand(-1, self.lanes)
        a, lam = at_time(Dynamics.unstabilized_accelerations, dynamics, t, self.x.q, self.x.v)
        least = dynamics.least_norm
        return a, lam if least is None else least.at_varying_time(dynamics.data, t, self.x.q, lam)


class Leaves:
    """Values of some lanes as leaves of a graph of torch, each with the tangents by which its gradient is multiplied.

    n   number of tangents; directions that are missing are zero
    """

    def __init__(self, n: int, lanes: int):
        self.n, self.lanes = n, lanes
        self.values: list[Tensor] = []
        self.tangents: list[Tensor] = []  # [n, component, lanes]
        self.lane_axes: list[int] = []

    def leaf(self, x: Tensor, tangents: Tensor | None, lane_axis: int = 0) -> Tensor:
        """A leaf with the value x; tangents [k, ...]: those beyond k are zero; None: all are."""
        y = x.detach()
        if tangents is None or not len(tangents):
            return y
        y = y.clone().requires_grad_()
        flat = self._flat(tangents.detach().unbind(), lane_axis)
        self.values.append(y)
        self.lane_axes.append(lane_axis)
        self.tangents.append(torch.nn.functional.pad(flat, (0, 0, 0, 0, 0, self.n - len(flat))))
        return y

    def number(self, x: Any) -> Tensor:
        """A leaf of a number [..., 1 + k, lanes]."""
        if not isinstance(x, Pair):
            return self.leaf(x, None)
        wide = expanded(x.full, self.lanes)
        return self.leaf(wide[..., :1, :], wide[..., 1:, :].movedim(-2, 0).unsqueeze(-2), -1)

    def tangents_of(self, y: Tensor) -> Tensor:
        """Tangents [m, n, lanes] of y [m, lanes], a function of the leaves lane by lane."""
        result = y.new_zeros(len(y), self.n, self.lanes)
        for i, row in enumerate(y.unbind()):
            if row.requires_grad:
                slopes = torch.autograd.grad(row.sum(), self.values, retain_graph=True, allow_unused=True)
                for s, dx, axis in zip(slopes, self.tangents, self.lane_axes, strict=True):
                    if s is not None:
                        result[i] += (dx * self._flat([s], axis)).sum(1)
        return result

    def _flat(self, parts: Sequence[Tensor], lane_axis: int) -> Tensor:
        """[parts, component, lanes]."""
        return torch.stack([x.movedim(lane_axis, -1).reshape(-1, self.lanes) for x in parts])


class _Instants(IntegratedSignals):
    """Positions and rates of a history of values at several times, which all lanes share; see the module header."""

    def __init__(self, dynamics: Dynamics, times: Tensor, history: History):
        super().__init__(history)
        self.dynamics, self.t = dynamics, times

    def _whole(self, name: str, rows: Rows, pair: slice) -> Tensor:
        if name in ("q", "v"):
            return super()._whole(name, rows, pair)
        x = self._solution[name == "lam"]
        return x if rows is None else select_rows(x, rows)

    @cached_property
    def _solution(self) -> Sequence[Tensor]:
        """Accelerations and multipliers [times, n, 1, lanes], as in `Instant`."""
        dynamics, T, lanes = self.dynamics, self.dynamics.topology, self.lanes

        def solution(data: Data, excitation: Prescribed, q: Tensor, v: Tensor) -> Tensor:
            t = excitation.t.repeat_interleave(lanes)
            return torch.cat(dynamics.with_data(data).unstabilized_accelerations(t, q, v))

        q, v = (self.history.rows(order) for order in range(2))
        a, lam = over_times(solution, T, dynamics.data, self.t, q, v).split([T.n_v, T.rows], 1)
        least = dynamics.least_norm
        return a, lam if least is None else least.at_times(dynamics.data, self.t, q, lam)


class SubstituteSignals(Signals):
    """Rows of other signals, but for tensors [lanes, times, n] of some names that take their place."""

    def __init__(self, base: Signals, substitutes: Mapping[str, Tensor]):
        super().__init__()
        self.base, self.substitutes, self.lanes, self.times = base, substitutes, base.lanes, base.times

    def _values(self, name: str, rows: Rows) -> Tensor:
        if name not in self.substitutes:
            return self.base.values(name, rows)
        x = self.substitutes[name]
        return x if rows is None else x[..., list(rows)]


@dataclass
class Views:
    """Makes motions of one time, the arguments of functions of the motion.

    whole       the motion's system and designs, with all lanes and no times; keeps the mode shapes that were asked for
    directions  tangents of designs by name [k, lanes, ...]; other designs have none
    """

    whole: Trajectory
    directions: dict[str, Tensor] = field(default_factory=dict)
    _shape_tangents: dict[str, Tensor] = field(default_factory=dict, init=False)

    @classmethod
    def of(
        cls,
        system: Any,
        dynamics: Dynamics,
        designs: dict[str, Tensor],
        directions: dict[str, Tensor] | None = None,
    ) -> Views:
        """Of the designs of a system; None: where no event ends a phase, and nothing reads them."""
        T, lanes = dynamics.topology, dynamics.lanes
        sizes = {"q": T.n_q, "v": T.n_v, "a": T.n_v, "lam": T.rows}
        no_times = TensorSignals({name: torch.zeros(lanes, 0, n, dtype=torch.float64) for name, n in sizes.items()})
        whole = Trajectory(
            t=torch.zeros(0, dtype=torch.float64),
            signals=no_times,
            shapes=GivenShapes({}.__getitem__) if system is None else DesignShapes(system, designs, lanes),
            status=[OK] * lanes,
            stats={},
            system=system,  # pyright: ignore[reportArgumentType]  # None is never read
            dynamics=dynamics,
            designs=designs,
        )
        return cls(whole, directions or {})

    def select_lanes(self, lanes: Sequence[int], dynamics: Dynamics) -> Views:
        """Views of some lanes alone; dynamics: of these."""
        index = list(lanes)
        designs = {name: x[index] for name, x in self.whole.designs.items()}
        return Views.of(self.whole.system, dynamics, designs, {k: dx[:, index] for k, dx in self.directions.items()})

    def values(self, dynamics: Dynamics) -> Views:
        """Views without tangents; dynamics: without these."""
        return Views.of(self.whole.system, dynamics, self.whole.designs)

    def along(self, event: Event, dynamics: Dynamics, times: Tensor, history: History) -> Tensor:
        """The function of all lanes at several times [lanes, times], the states at which are a history of these dynamics."""
        signals = _Instants(dynamics, times, history)
        turns = None if self.whole.turns is None else self.whole.turns.at(times[:1])
        return event.of(replace(self.whole, t=times, signals=signals, dynamics=dynamics, known=None, turns=turns))

    def value(self, event: Event, lanes: Sequence[int], dynamics: Dynamics, t: Any, x: State) -> Tensor:
        """The function of some lanes [lanes], each at its own time."""
        adjoint = torch.is_grad_enabled()  # goes again through a motion whose events were checked
        with torch.enable_grad():
            g = self.evaluate(event.at_once, lanes, dynamics.values(), value(t), x.values())[0, 0]
        if not adjoint:
            refuse_lost_gradients(("phases", "until", "function"), g, "constant tensors", self.whole.designs.values())
        return g if adjoint else g.detach()

    def of_lanes(self, event: Event, dynamics: Dynamics, t: Tensor, x: State) -> Tensor:
        """The function of all lanes [lanes], each at its own time, in the graph of its arguments."""
        return self.evaluate(event.at_once, range(x.q.shape[-1]), dynamics, t, x)[0, 0]

    def at(self, lanes: Sequence[int], dynamics: Dynamics, t: Tensor, x: State) -> Trajectory:
        """The motion of some lanes at t [1 + n, lanes], or [1 + n, 1] of all, a function of all arguments."""
        now = value(t)[0] if t.shape[-1] == 1 else torch.empty(0, dtype=torch.float64).as_subclass(_TimesOfLanes)
        turns = self._turns_of(lanes)
        return replace(
            self.whole,
            status=[OK] * len(lanes),
            designs={name: y[list(lanes)] for name, y in self.whole.designs.items()},
            shapes=SomeLanes(self.whole.shapes, lanes),
            t=now,
            signals=Instant(dynamics, t, x),
            dynamics=dynamics,
            known=None,
            turns=None if turns is None else turns.at(value(t)[0]),
        )

    def with_leaves(
        self, lanes: Sequence[int], design: Callable[[str, Tensor], Tensor], shape: Callable[[str, Tensor], Tensor]
    ) -> Views:
        """Views of some lanes alone, with designs and mode shapes replaced by those of functions (name, values)."""
        kept = SomeLanes(self.whole.shapes, lanes)
        whole = replace(
            self.whole,
            status=[OK] * len(lanes),
            designs={name: design(name, y[list(lanes)]) for name, y in self.whole.designs.items()},
            shapes=GivenShapes(lambda name: shape(name, kept.values(name).detach())),
            turns=self._turns_of(lanes),
        )
        return Views(whole)

    def continuing(self, times: Tensor, q: Tensor, states: Callable[[Tensor], tuple[Tensor, Tensor]]) -> Views:
        """The same for a motion that is recorded: angles continue what is there; arguments as in `Turns`."""
        return replace(self, whole=replace(self.whole, turns=Turns(self.whole, times, q, states)))

    def _turns_of(self, lanes: Sequence[int]) -> Turns | None:
        turns = self.whole.turns
        return None if turns is None else turns.of_lanes(list(lanes))

    def evaluate(
        self, f: Callable[[Trajectory], Tensor], lanes: Sequence[int], dynamics: Dynamics, t: Any, x: State
    ) -> Any:
        """f [m, lanes] of the motion of some lanes as a number [m, 1 + n, lanes], with tangents if t has any.

        dynamics, t, x   of these lanes
        """
        try:
            return self._evaluate(f, lanes, dynamics, t, x)
        except _TimeRead:
            each = [
                (lanes_of(dynamics, [i]), pick_lanes(t, [i]), x.map(lambda y, i=i: pick_lanes(y, [i])))
                for i in range(len(lanes))
            ]
            return join_lanes(
                [self._evaluate(f, [lane], *arguments) for lane, arguments in zip(lanes, each, strict=True)]
            )

    def _evaluate(
        self, f: Callable[[Trajectory], Tensor], lanes: Sequence[int], dynamics: Dynamics, t: Any, x: State
    ) -> Any:
        if not isinstance(t, Pair):
            return f(self.at(lanes, dynamics, t, x))[:, None]
        leaves = Leaves(t.shape[0] - 1, len(lanes))
        with torch.enable_grad():
            views = self.with_leaves(
                lanes,
                lambda name, y: leaves.leaf(
                    y, self.directions[name][:, list(lanes)] if name in self.directions else None
                ),
                lambda name, y: leaves.leaf(y, self._tangents_of_shapes(name, lanes)),
            )
            data = {name: leaves.number(y) for name, y in dynamics.data.items()}
            every = range(len(lanes))
            y = f(views.at(every, dynamics.with_data(data), leaves.number(t), x.map(leaves.number)))
            slopes = leaves.tangents_of(y)
        return Pair.of(y.detach()[:, None], slopes)

    def slopes(self, event: Event, lanes: Sequence[int], dynamics: Dynamics, t: Any, x: State) -> tuple[Tensor, Tensor]:
        """The function of some lanes [lanes] and its derivatives [n, lanes] in the directions of the pairs."""
        g = self.evaluate(event.at_once, lanes, dynamics, t, x)
        return g.value[0, 0], g.tangent[0]

    def rates(
        self, event: Event, lanes: Sequence[int], dynamics: Dynamics, t: Tensor, x: State, slopes: State
    ) -> tuple[Tensor, Tensor]:
        """The function of some lanes [lanes] at times t [1, lanes], and its rate along a motion with these slopes."""
        moving = State(*(Pair.of(y, dy) for y, dy in zip(x, slopes, strict=True)))
        g, rate = self.slopes(event, lanes, dynamics, Pair.of(t, torch.ones_like(t)), moving)
        return g, rate[0]

    def _tangents_of_shapes(self, name: str, lanes: Sequence[int]) -> Tensor | None:
        """Tangents of the mode shapes of a body [k, lanes, nodes, 6, modes] of some lanes."""
        if not self.directions:
            return None
        if name not in self._shape_tangents:
            self._shape_tangents[name] = shape_tangents(self.whole.system, self.whole.designs, self.directions, name)
        return self._shape_tangents[name][:, list(lanes)]


def gap_gradient(
    event: Event, views: Views, lanes: Sequence[int], dynamics: Dynamics, t: Any, x: State
) -> tuple[Any, Any]:
    """Derivatives of a gap g(q, t) of some lanes: by increments of q [n_v, ...] and by time [1, ...]; pairs if x are."""
    T = dynamics.topology

    def slope(motion: Trajectory) -> Tensor:
        kept = torch.is_grad_enabled()
        with torch.enable_grad():
            step = torch.zeros(T.n_v + 1, motion.lanes, dtype=torch.float64, requires_grad=True)
            q = equations.advance(T, motion.q[:, 0].T[:, None], step[: T.n_v, None])
            signals = SubstituteSignals(motion.signals, {"q": q[:, 0].T[:, None]})
            now = motion.t if motion.lanes > 1 else motion.t + step[T.n_v]  # of several lanes it is not read
            g = event.of(replace(motion, signals=signals, t=now, known=None))
            if not g.requires_grad:
                return torch.zeros_like(step).detach()
            return torch.autograd.grad(g.sum(), step, create_graph=kept)[0]

    both = views.evaluate(slope, lanes, dynamics, t, x)
    return both[: T.n_v], both[T.n_v :]
