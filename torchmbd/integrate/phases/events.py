"""Events: the first time at which a function of the motion passes zero, and its derivatives.

    g(t*, x(t*, b)) = 0        dt*/db = -g_b / g_t        both total derivatives along the motion

g is a function: motion -> [lanes, times], written as for a history; here the motion has one time only. torch differentiates g
in reverse mode by all that it may depend on: time, state, data of the model, designs and mode shapes. Where these have
tangents, so has g.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.variable_step import least_norm_multipliers
from torchmbd.math.gradients import refuse_lost_gradients
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.mode_shapes import DesignShapes, GivenShapes, OneLane, shape_tangents
from torchmbd.results.motion_data import OK
from torchmbd.results.state import State
from torchmbd.results.time_rows import Rows, Signals, TensorSignals
from torchmbd.results.trajectory import Trajectory

DIRECTIONS = {"falling": -1, "rising": 1, "either": 0}


@dataclass(frozen=True)
class Event:
    """The time when a function of the motion passes zero; it ends a phase.

    function   motion -> [lanes, times], written with torch operations; or a history, such as Position("mass", "z")
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
                f"function of an event is {self.function!r}; allowed: a function motion -> [lanes, times] or a history"
            )
        refuse_lost_gradients("function of an event", self.function, "constant tensors")
        if not isinstance(self.direction, str) or self.direction not in DIRECTIONS:
            raise InputError(f"direction of an event is {self.direction!r}; allowed: {', '.join(DIRECTIONS)}")

    def of(self, motion: Trajectory) -> Tensor:
        """The function [lanes, times]; InputError if it returns anything else."""
        g = self.function.values(motion) if hasattr(self.function, "values") else self.function(motion)
        shape = (motion.lanes, len(motion.t))
        if not isinstance(g, Tensor) or g.shape != shape:
            returned = f"shape {tuple(g.shape)}" if isinstance(g, Tensor) else repr(g)
            raise InputError(f"the function of an event returned {returned}; allowed: a tensor [lanes, times], {shape}")
        return g

    def passed(self, before: Tensor, after: Tensor) -> Tensor:
        """Whether the function passed zero between two values [lanes]; not if the first one is a rounding error."""
        sign = DIRECTIONS[self.direction]
        falls, rises = (before > 0) & (after <= 0), (before < 0) & (after >= 0)
        passed = (falls & (sign <= 0)) | (rises & (sign >= 0))
        return passed & (before.abs() > 1e-9 * after.abs())


class Instant(Signals):
    """A state x at a time t [1 + n, 1] as a motion of this time alone."""

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
        return self._lam if name == "lam" else {"q": self.x.q, "v": self.x.v, "a": self.x.vd}[name]

    @cached_property
    def _lam(self) -> Any:
        return least_norm_multipliers(self.dynamics, self.t, self.x)


class Leaves:
    """Values of one lane as leaves of a graph of torch, each with the tangents by which its gradient is multiplied.

    n   number of tangents; directions that are missing are zero
    """

    def __init__(self, n: int):
        self.n = n
        self.values: list[Tensor] = []
        self.tangents: list[Tensor] = []

    def leaf(self, x: Tensor, tangents: Tensor | None) -> Tensor:
        """A leaf with the value x; tangents [k, ...]: those beyond k are zero; None: all are."""
        y = x.detach()
        if tangents is None or not len(tangents):
            return y
        y = y.clone().requires_grad_()
        flat = tangents.detach().reshape(len(tangents), -1)
        self.values.append(y)
        self.tangents.append(torch.nn.functional.pad(flat, (0, 0, 0, self.n - len(flat))))
        return y

    def number(self, x: Any) -> Tensor:
        """A leaf of a number [..., 1 + k, 1]."""
        return self.leaf(value(x), x.tangent.movedim(-2, 0) if isinstance(x, Pair) else None)

    def tangents_of(self, y: Tensor) -> Tensor:
        """Tangents [m, n] of y [m], a function of the leaves."""
        result = y.new_zeros(len(y), self.n)
        for i, row in enumerate(y.unbind()):
            if row.requires_grad:
                slopes = torch.autograd.grad(row, self.values, retain_graph=True, allow_unused=True)
                parts = [dx @ s.flatten() for s, dx in zip(slopes, self.tangents, strict=True) if s is not None]
                result[i] = torch.stack(parts).sum(0) if parts else 0.0
        return result


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
        T, lanes = dynamics.topology, dynamics.lanes
        sizes = {"q": T.n_q, "v": T.n_v, "a": T.n_v, "lam": T.rows}
        no_times = TensorSignals({name: torch.zeros(lanes, 0, n, dtype=torch.float64) for name, n in sizes.items()})
        whole = Trajectory(
            t=torch.zeros(0, dtype=torch.float64),
            signals=no_times,
            shapes=DesignShapes(system, designs, lanes),
            status=[OK] * lanes,
            stats={},
            system=system,
            dynamics=dynamics,
            designs=designs,
        )
        return cls(whole, directions or {})

    def values(self, event: Event, dynamics: Dynamics, t: Tensor, x: State) -> Tensor:
        """The function at time t [] of all lanes [lanes]."""
        motion = self._motion(self.whole, dynamics, t[None, None], x.values())
        return event.of(motion)[:, 0]

    def value(self, event: Event, lane: int, dynamics: Dynamics, t: Any, x: State) -> Tensor:
        """The function of one lane []."""
        return event.of(self.at(lane, dynamics.values(), value(t), x.values()))[0, 0]

    def at(self, lane: int, dynamics: Dynamics, t: Tensor, x: State) -> Trajectory:
        """The motion of one lane at t [1, 1], a function of all arguments."""
        one = replace(
            self.whole,
            status=[OK],
            designs={name: y[lane : lane + 1] for name, y in self.whole.designs.items()},
            shapes=OneLane(self.whole.shapes, lane),
        )
        return self._motion(one, dynamics, t, x)

    def with_leaves(
        self, lane: int, design: Callable[[str, Tensor], Tensor], shape: Callable[[str, Tensor], Tensor]
    ) -> Views:
        """Views of one lane, its lane 0, with designs and mode shapes replaced by those of functions (name, values)."""
        kept = OneLane(self.whole.shapes, lane)
        whole = replace(
            self.whole,
            designs={name: design(name, y[lane : lane + 1]) for name, y in self.whole.designs.items()},
            shapes=GivenShapes(lambda name: shape(name, kept.values(name).detach())),
        )
        return Views(whole)

    def evaluate(self, f: Callable[[Trajectory], Tensor], lane: int, dynamics: Dynamics, t: Any, x: State) -> Any:
        """f [m] of the motion of one lane as a number [m, 1 + n, 1], with tangents if t has any; else [m, 1, 1]."""
        if not isinstance(t, Pair):
            return f(self.at(lane, dynamics, t, x))[:, None, None]
        leaves = Leaves(t.shape[0] - 1)
        with torch.enable_grad():
            views = self.with_leaves(
                lane,
                lambda name, y: leaves.leaf(y, self._design_tangents(name, lane)),
                lambda name, y: leaves.leaf(y, self._tangents_of_shapes(name, lane)),
            )
            data = {name: leaves.number(y) for name, y in dynamics.data.items()}
            y = f(views.at(0, replace(dynamics, data=data), leaves.number(t), x.map(leaves.number)))
            slopes = leaves.tangents_of(y)
        return Pair.of(y.detach()[:, None, None], slopes[..., None])

    def slopes(self, event: Event, lane: int, dynamics: Dynamics, t: Any, x: State) -> tuple[Tensor, Tensor]:
        """The function of one lane [] and its derivatives [n] in the directions of the pairs."""
        g = self.evaluate(lambda motion: event.of(motion)[0], lane, dynamics, t, x)
        return g.value[0, 0, 0], g.tangent[0, :, 0]

    def _design_tangents(self, name: str, lane: int) -> Tensor | None:
        """Tangents of a design [k, ...] of one lane."""
        return self.directions[name][:, lane] if name in self.directions else None

    def _tangents_of_shapes(self, name: str, lane: int) -> Tensor | None:
        """Tangents of the mode shapes of a body [k, nodes, 6, modes] of one lane."""
        if not self.directions:
            return None
        if name not in self._shape_tangents:
            self._shape_tangents[name] = shape_tangents(self.whole.system, self.whole.designs, self.directions, name)
        return self._shape_tangents[name][:, lane]

    @staticmethod
    def _motion(base: Trajectory, dynamics: Dynamics, t: Any, x: State) -> Trajectory:
        """t [1 + n, 1]."""
        return replace(base, t=value(t)[0], signals=Instant(dynamics, t, x), dynamics=dynamics, known=None)


def gap_gradient(event: Event, views: Views, lane: int, dynamics: Dynamics, t: Any, x: State) -> tuple[Any, Any]:
    """Derivatives of a gap g(q, t) of one lane: by increments of q [n_v, ...] and by time [1, ...]; pairs if x are."""
    T = dynamics.topology

    def slope(motion: Trajectory) -> Tensor:
        kept = torch.is_grad_enabled()
        with torch.enable_grad():
            step = torch.zeros(T.n_v + 1, dtype=torch.float64, requires_grad=True)
            q = equations.advance(T, motion.q[0].T[:, None], step[: T.n_v, None, None])
            others = {name: motion.signals.values(name) for name in ("v", "a", "lam")}
            signals = TensorSignals({"q": q[:, 0].T[None]} | others)
            moved = replace(motion, signals=signals, t=motion.t + step[T.n_v], known=None)
            g = event.of(moved)[0, 0]
            if not g.requires_grad:
                return torch.zeros_like(step).detach()
            return torch.autograd.grad(g, step, create_graph=kept)[0]

    both = views.evaluate(slope, lane, dynamics, t, x)
    return both[: T.n_v], both[T.n_v :]
