"""The numbers of a motion: coordinates, rates, accelerations, multipliers, their sensitivities, and switches between phases.

Checked in tests/integrate/test_simulate.py, tests/integrate/test_motion.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Self, TypeVar

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, SimulationFailure, one_of
from torchmbd.math.gradients import all_true
from torchmbd.math.module_call import run_with_parameters
from torchmbd.multibody.forces.action import Action
from torchmbd.multibody.saddle.rank import Rank
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.system import System
from torchmbd.results.mode_shapes import Shapes, SomeLanes
from torchmbd.results.time_rows import (
    IntegratedSignals,
    Integration,
    Rows,
    Signals,
    SomeTimes,
    TensorSignals,
    detached,
)
from torchmbd.results.turns import Turns
from torchmbd.summary import Summary, few

OK = "ok"
R = TypeVar("R")


def has_failed(status: str) -> bool:
    """True if a lane has no motion, or one that ends early; one that is unresolved has all its numbers."""
    return status.startswith("failed")


@dataclass(frozen=True, eq=False, repr=False)
class Moment:
    """The state of all lanes on one side of a switch [lanes, n], with sensitivities [lanes, n, n_b]."""

    q: Tensor
    v: Tensor
    a: Tensor
    lam: Tensor
    dq_db: Tensor | None = None
    dv_db: Tensor | None = None
    da_db: Tensor | None = None
    dlam_db: Tensor | None = None

    def __repr__(self) -> str:
        given = [(f.name, getattr(self, f.name)) for f in fields(self)]
        return f"Moment({', '.join(f'{name} {list(x.shape)}' for name, x in given if x is not None)})"

    def detach(self) -> Moment:
        """The same numbers without a graph of torch."""
        return replace(self, **{name: getattr(self, name).detach() for name in ("q", "v", "a", "lam")})

    def of_lanes(self, lanes: Tensor) -> Moment:
        """Of some lanes."""
        parts = (getattr(self, f.name) for f in fields(self))
        return Moment(*(None if x is None else x.index_select(0, lanes) for x in parts))  # pyright: ignore[reportArgumentType]

    def with_lanes(self, lanes: Tensor, other: Moment, sources: Tensor) -> Moment:
        """The same with some lanes from another one."""
        return Moment(
            *(_with_lanes(getattr(self, f.name), lanes, getattr(other, f.name), sources) for f in fields(self))
        )


@dataclass(frozen=True, eq=False, repr=False)
class Switch:
    """The switch of all lanes into a phase; sensitivities follow the time of the switch, which moves with the design.

    t [lanes] (inf: a lane that does not get there), dt_db [lanes, n_b]; before, after: equal positions

    Accelerations and multipliers `before` are those of the last step of the phase, as everywhere in a motion. Those of
    `after` solve the equations of motion at t for the positions and velocities there.
    """

    phase: str
    t: Tensor
    before: Moment
    after: Moment
    dt_db: Tensor | None = None

    def __repr__(self) -> str:
        """The phase that begins, and when: of a list of switches one line each."""
        times = few([f"{t:.6g} s" if math.isfinite(t) else "never" for t in self.t.tolist()])
        return f"Switch({self.phase!r} begins at t = {times})"

    def detach(self) -> Switch:
        """The same numbers without a graph of torch."""
        return replace(self, t=self.t.detach(), before=self.before.detach(), after=self.after.detach())

    def of_lanes(self, lanes: Tensor) -> Switch:
        """Of some lanes."""
        dt_db = None if self.dt_db is None else self.dt_db.index_select(0, lanes)
        sides = self.before.of_lanes(lanes), self.after.of_lanes(lanes)
        return Switch(self.phase, self.t.index_select(0, lanes), *sides, dt_db)

    def with_lanes(self, lanes: Tensor, other: Switch, sources: Tensor) -> Switch:
        """The same switch with some lanes from another motion."""
        return replace(
            self,
            t=_with_lanes(self.t, lanes, other.t, sources),
            before=self.before.with_lanes(lanes, other.before, sources),
            after=self.after.with_lanes(lanes, other.after, sources),
            dt_db=_with_lanes(self.dt_db, lanes, other.dt_db, sources),
        )


def _with_lanes(x: Tensor | None, lanes: Tensor, other: Tensor | None, sources: Tensor) -> Any:
    """Numbers [lanes, ...] with some lanes from others."""
    return x if x is None or other is None else x.index_copy(0, lanes, other.index_select(0, sources))


@dataclass(eq=False, repr=False)
class MotionData(Summary):
    """The numbers of a motion of one design or of a batch; `Trajectory` (trajectory.py) adds what is read from them.

    t           times [times] [s]
    q, v, a     coordinates [lanes, times, n_q] [m, -], rates [lanes, times, n_v] [m/s, rad/s] and accelerations; a rigid body
                whose origin is far from its center of mass has those of the center (equations/base_points.py)
    lam         multipliers [lanes, times, rows] [N, N m]
    dq_db, ...  their sensitivities, the design axis last [..., n_b]
    system      the model;  dynamics: its equations of motion for these designs
    known       results that measures evaluated together share
    signals     coordinates, rates, accelerations and multipliers by rows
    shapes      mode shapes of the designs
    status      for each lane "ok"; "failed: ..." with the reason, its numbers nan from there on; or "unresolved: ...", all
                numbers there, where the vibrations that they show are no more than errors of the steps
    stats       numbers of the integration
    designs     parameters of the lanes by name, [lanes, ...]
    parameters  names of the design variables of the sensitivities, one for each tangent
    switches    those into the second phase and all later ones
    good        which lanes have not failed [lanes], also where torch.func.vmap makes several motions of one; None: all
    actions     applied forces of each segment; none where each has all joints and laws of the system
    variables   designs by which the motion is differentiable, by name [lanes, ...]: inputs of torch.autograd.grad
    turns       of an instant of a motion that is being integrated: what its angles continue (turns.py)
    integration how it was integrated, with its tangents if it has any (forward_integration.py, reverse_integration.py)
    """

    t: Tensor
    signals: Signals = field(repr=False)
    status: list[str]
    stats: dict[str, Any]
    system: System
    dynamics: Dynamics
    shapes: Shapes = field(repr=False)
    designs: dict[str, Tensor] = field(default_factory=dict)
    parameters: tuple[str, ...] = ()
    switches: list[Switch] = field(default_factory=list)
    actions: tuple[tuple[Action, ...], ...] = ()
    known: dict[Any, Any] | None = field(default=None, repr=False)
    good: Tensor | None = field(default=None, repr=False)
    variables: dict[str, Tensor] = field(default_factory=dict, repr=False)
    integration: Integration | None = field(default=None, repr=False)
    turns: Turns | None = field(default=None, repr=False)

    def _summary(self) -> list[tuple[str, Any]]:
        T, wrong = self.dynamics.topology, [status for status in self.status if status != OK]
        status = f"{len(wrong)} of {len(self.status)} lanes: {wrong[0]}" if wrong else OK
        rows = [
            ("status", status),
            ("lanes", self.lanes),
            ("time", f"{float(self.t[0]):g} to {float(self.t[-1]):g} s, {len(self.t)} times"),
            ("bodies", few(T.names)),
            ("coordinates", f"{T.n_q} (q), {T.n_v} rates (v, a), {T.rows} multipliers (lam)"),
        ]
        redundant = list(dict.fromkeys(row for rank in self.ranks for row in rank.redundant))
        if redundant:
            rows.append(("over-constraint", f"rows that follow from others: {few(redundant)}"))
        return rows + [(name, self.stats[name]) for name in ("steps", "backend", "gradients") if name in self.stats]

    @property
    def lanes(self) -> int:
        """Number of designs."""
        return self.signals.lanes

    @property
    def ranks(self) -> Sequence[Rank]:
        """The rank of the constraints that act in each part of the motion; none if no integrator made its states.

        Rows of locks do not hold at the start of the motion, and released rows do not act together with these.
        """
        made = self.signals.integration if isinstance(self.signals, IntegratedSignals) else None
        return () if made is None else made.ranks

    @property
    def is_single(self) -> bool:
        """True if the motion has no switches, and all joints and laws of the system act."""
        return not self.actions and not self.switches

    @property
    def q(self) -> Tensor:
        """Coordinates [lanes, times, n_q]."""
        return self.signals.values("q")

    @property
    def v(self) -> Tensor:
        """Rates [lanes, times, n_v]."""
        return self.signals.values("v")

    @property
    def a(self) -> Tensor:
        """Accelerations [lanes, times, n_v]."""
        return self.signals.values("a")

    @property
    def lam(self) -> Tensor:
        """Multipliers [lanes, times, rows], of redundant rows those of least norm; computed on demand."""
        return self.signals.values("lam")

    @property
    def dq_db(self) -> Tensor | None:
        """Sensitivities of the coordinates [lanes, times, n_q, n_b]."""
        return self.tangents("q")

    @property
    def dv_db(self) -> Tensor | None:
        """Sensitivities of the rates [lanes, times, n_v, n_b]."""
        return self.tangents("v")

    @property
    def da_db(self) -> Tensor | None:
        """Sensitivities of the accelerations [lanes, times, n_v, n_b]."""
        return self.tangents("a")

    @property
    def dlam_db(self) -> Tensor | None:
        """Sensitivities of the multipliers [lanes, times, rows, n_b]."""
        return self.tangents("lam")

    def tangents(self, name: str, rows: Rows = None) -> Tensor | None:
        """Sensitivities of rows [lanes, times, k, n_b]; InputError if gradients come by the adjoint."""
        from_adjoint = self.integration is not None and self.stats.get("gradients") == "reverse"
        if from_adjoint:
            raise InputError(
                "gradients",
                "reverse",
                noun=f"d{name}_db:",
                state="the gradients of this motion come from the adjoint, which does not compute sensitivities of coordinates",
                hint="simulate(..., gradients='forward')",
            )
        return self.sensitivities.tangents(name, rows)

    @cached_property
    def sensitivities(self) -> Signals:
        """The same rows, values and tangents, as plain numbers."""
        made = self.integration
        if made is None or not made.variables:
            return self.signals
        valid_times = self.signals.valid_times if isinstance(self.signals, IntegratedSignals) else None
        return IntegratedSignals(made.history, made, made.dynamics.data, valid_times)

    def detach(self) -> Self:
        """The same numbers without a graph of torch."""
        return replace(
            self,
            t=self.t.detach(),
            signals=self.signals.detach(),
            dynamics=replace(self.dynamics, data={k: detached(x) for k, x in self.dynamics.data.items()}),
            shapes=self.shapes.detach(),
            designs={name: x.detach() for name, x in self.designs.items()},
            variables={},
            switches=[switch.detach() for switch in self.switches],
            known=None,
        )

    def __getstate__(self) -> dict[str, Any]:
        """Numbers only: a graph of torch is not kept."""
        return vars(self.detach())

    @property
    def ok(self) -> bool:
        """True if every lane succeeded."""
        return all(status == OK for status in self.status)

    def require_ok(self) -> Self:
        """Return self, or raise SimulationFailure with the first reason."""
        for lane, status in enumerate(self.status):
            if status != OK:
                raise SimulationFailure(f"lane {lane}: {status}")
        return self

    def sound(self, x: Tensor) -> Tensor:
        """A function [lanes, ...] of the motion, without derivatives in lanes that failed: those of nan would be nan.

        One that depends on no parameter has gradients of zero.
        """
        moving = [y for y in self.variables.values() if y.requires_grad]
        if moving and torch.is_grad_enabled() and not x.requires_grad:
            nothing = torch.stack([0.0 * y.reshape(len(y), -1).sum(1) for y in moving]).sum(0)
            x = x + nothing.reshape(-1, *[1] * (x.dim() - 1))
        if self.good is None or all_true(self.good):
            return x
        return torch.where(self.good.reshape(-1, *[1] * (x.dim() - 1)), x, x.detach())

    def modes(self, name: str) -> Tensor:
        """Mode shapes [lanes, nodes, 6, modes] of a flexible body: the structure stage of the designs, once more."""
        T = self.dynamics.topology
        return self.shapes.values(one_of("flexible body", name, T.names[: T.flexible]))

    def of_designs(self, function: Callable[[], R], *modules: nn.Module) -> R:
        """function() while parameters of the system, and of modules that share them, are those of the designs [lanes, ...]."""
        designs = {f"0.{name}": x for name, x in self.designs.items()}
        return run_with_parameters(nn.ModuleList([self.system, *modules]), designs, function)

    def at_moment(self, lane: int, t: Tensor, moment: Moment) -> Self:
        """One lane at one side of a switch at its time t [], as a motion of one time without sensitivities."""
        there = {name: getattr(moment, name)[lane : lane + 1, None] for name in ("q", "v", "a", "lam")}
        return self.one_lane(lane, t[None], TensorSignals(there))

    def parts(self, most: int) -> Iterator[Self]:
        """The motion by parts of its times with at most so many states of all lanes, without sensitivities."""
        length = max(1, most // self.lanes)
        for first in range(0, len(self.t), length):
            chosen = slice(first, first + length)
            plain = {"switches": [], "known": None, "integration": None, "variables": {}, "parameters": ()}
            yield replace(self, t=self.t[chosen], signals=SomeTimes(self.signals, chosen), **plain)

    def at_rest(self, index: int) -> Self:
        """The machine at rest at all times where it is at one of them: without rates, forces and sensitivities."""
        there = self.q.detach()[:, index, None].expand(-1, len(self.t), -1)
        still = {name: torch.zeros_like(getattr(self, name)) for name in ("v", "a", "lam")}
        plain = {"switches": [], "known": None, "integration": None, "variables": {}, "parameters": ()}
        return replace(self, signals=TensorSignals({"q": there, **still}), **plain)

    def one_lane(self, lane: int, t: Tensor, signals: Signals) -> Self:
        """One lane with other times and rows, without sensitivities."""
        row = slice(lane, lane + 1)
        return replace(
            self,
            t=t,
            signals=signals,
            status=self.status[row],
            dynamics=self.dynamics.select_lanes([lane]),
            shapes=SomeLanes(self.shapes, [lane]),
            designs={name: x[row] for name, x in self.designs.items()},
            parameters=(),
            good=None if self.good is None else self.good[row],
            switches=[],
            known=None,
            variables={},
            integration=None,
        )
