"""Events: the first time at which a function of the motion passes zero, and its derivatives.

    g(t*, x(t*, b)) = 0        dt*/db = -g_b / g_t        both total derivatives along the motion

g is a function: motion -> [lanes, times], written as for a history; here it sees one time only. Its derivatives by
design and time come from the neighbors of the motion, as those of every response do.
Checked in tests/integrators/test_phases.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrators.shapes import DesignShapes, OneLane
from torchmbd.integrators.signals import Given, Rows, Signals
from torchmbd.integrators.sized import determined
from torchmbd.integrators.step import State
from torchmbd.integrators.trajectory import OK, Trajectory
from torchmbd.numerics.gradients import refuse_lost
from torchmbd.numerics.pair import Pair, value
from torchmbd.system import equations
from torchmbd.system.dynamics import Dynamics

DIRECTIONS = {"falling": -1, "rising": 1, "either": 0}


@dataclass(frozen=True)
class Event:
    """`Event(function, direction="either")`: when a function of the motion passes zero.

    function   motion -> [lanes, times], written with torch operations; or a history, such as Position("mass", "z")
    direction  "falling", "rising" or "either"
    """

    function: Any
    direction: str = "either"

    def __post_init__(self) -> None:
        if not callable(self.function) and not hasattr(self.function, "values"):
            raise InputError(
                f"function of an event is {self.function!r}; allowed: a function motion -> [lanes, times] or a history"
            )
        refuse_lost("function of an event", self.function, "constant tensors")
        if self.direction not in DIRECTIONS:
            raise InputError(f"direction of an event is {self.direction!r}; allowed: {', '.join(DIRECTIONS)}")

    def of(self, motion: Trajectory) -> Tensor:
        """The function [lanes, times]; InputError if it returns anything else."""
        g = self.function.values(motion) if hasattr(self.function, "values") else self.function(motion)
        shape = (motion.lanes, len(motion.t))
        if not isinstance(g, Tensor) or g.shape != shape:
            found = f"shape {tuple(g.shape)}" if isinstance(g, Tensor) else repr(g)
            raise InputError(f"the function of an event returned {found}; allowed: a tensor [lanes, times], {shape}")
        return g

    def passed(self, before: Tensor, after: Tensor) -> Tensor:
        """Whether the function passed zero between two values [lanes]; not if the first one is nothing but rounding."""
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
        return determined(self.dynamics, self.t, self.x)


@dataclass
class Views:
    """Makes motions of one time, for functions of the motion to look at.

    whole  the motion's system, designs and parameters, with all lanes; keeps the mode shapes that were asked for
    """

    whole: Trajectory

    @classmethod
    def of(cls, system: Any, dynamics: Dynamics, designs: dict[str, Tensor], parameters: tuple[str, ...]) -> Views:
        T, lanes = dynamics.topology, dynamics.lanes
        sizes = {"q": T.n_q, "v": T.n_v, "a": T.n_v, "lam": T.rows}
        nothing = Given({name: torch.zeros(lanes, 0, n, dtype=torch.float64) for name, n in sizes.items()})
        whole = Trajectory(
            t=torch.zeros(0, dtype=torch.float64),
            signals=nothing,
            shapes=DesignShapes(system, designs, parameters, lanes),
            status=[OK] * lanes,
            stats={},
            system=system,
            dynamics=dynamics,
            designs=designs,
            parameters=parameters,
        )
        return cls(whole)

    def values(self, event: Event, dynamics: Dynamics, t: Tensor, x: State) -> Tensor:
        """The function at time t [] of all lanes [lanes]."""
        motion = self._motion(self.whole, dynamics, t[None, None], x.values())
        return event.of(motion)[:, 0]

    def _lane(self, lane: int, dynamics: Dynamics, t: Any, x: State) -> Trajectory:
        """The motion of one lane at t [1 + n, 1]."""
        one = replace(
            self.whole,
            status=[OK],
            designs={name: y[lane : lane + 1] for name, y in self.whole.designs.items()},
            shapes=OneLane(self.whole.shapes, lane, t.shape[0] - 1),
        )
        return self._motion(one, dynamics, t, x)

    def neighbors(self, lane: int, dynamics: Dynamics, t: Any, x: State) -> Callable[[Tensor], Trajectory]:
        """The motion of one lane at t, a number [1 + n, 1], as a function of delta [n], to first order."""
        motion = self._lane(lane, dynamics, t, x)
        if not isinstance(t, Pair):
            return lambda delta: motion
        return lambda delta: replace(motion.moved(delta), t=motion.t + delta @ t.tangent[:, 0], known=None)

    def value(self, event: Event, lane: int, dynamics: Dynamics, t: Any, x: State) -> Tensor:
        """The function of one lane []."""
        return event.of(self._lane(lane, dynamics.values(), value(t), x.values()))[0, 0]

    def slopes(self, event: Event, lane: int, dynamics: Dynamics, t: Any, x: State) -> tuple[Tensor, Tensor]:
        """The function of one lane [] and its derivatives [n] in the directions of the pairs."""
        moved = self.neighbors(lane, dynamics, t, x)
        zero = torch.zeros(t.shape[0] - 1, dtype=torch.float64)
        return event.of(moved(zero))[0, 0], torch.func.jacfwd(lambda delta: event.of(moved(delta))[0, 0])(zero)

    @staticmethod
    def _motion(base: Trajectory, dynamics: Dynamics, t: Any, x: State) -> Trajectory:
        """t [1 + n, 1]."""
        return replace(base, t=value(t)[0], signals=Instant(dynamics, t, x), dynamics=dynamics, known=None)


def normal(event: Event, views: Views, lane: int, dynamics: Dynamics, t: Any, x: State) -> tuple[Any, Any]:
    """Derivatives of a gap g(q, t) of one lane: by increments of q [n_v, ...] and by time [1, ...]; pairs if x are."""
    T = dynamics.topology
    moved = views.neighbors(lane, dynamics, t, x)

    def gap(step: Tensor, delta: Tensor) -> Tensor:
        motion = moved(delta)
        q = equations.advance(T, motion.q[0].T[:, None], step[: T.n_v, None, None])
        others = {name: motion.signals.values(name) for name in ("v", "a", "lam")}
        signals = Given({"q": q[:, 0].T[None]} | others)
        there = replace(motion, signals=signals, t=motion.t + step[T.n_v], known=None)
        return event.of(there)[0, 0]

    def slope(delta: Tensor) -> Tensor:
        return torch.func.jacfwd(gap)(delta.new_zeros(T.n_v + 1), delta)  # pyright: ignore[reportReturnType]

    zero = torch.zeros(t.shape[0] - 1, dtype=torch.float64)
    both: Any = slope(zero)[:, None, None]
    if isinstance(x.q, Pair):
        tangents: Any = torch.func.jacfwd(slope)(zero)
        both = Pair.of(both, tangents[..., None])
    return both[: T.n_v], both[T.n_v :]
