"""A motion by equal steps whose reverse mode is the discrete adjoint; see motion.py and adjoint.py.

    inputs    the data of the reduced model, in the order of `names`; with `duration_is_input` the duration [1, 1] behind them
    outputs   q, v, v', lam [times, n, 1, lanes] of the condensed system, the validity of the lanes
              (lane_status.py), and, where lanes have smaller steps, the states at these (`History.at_steps`)

Tangents are integrated when they are asked for, together with the values once more.
Checked in tests/integrate/test_motion.py, tests/sensitivity/test_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.adjoint import Adjoint
from torchmbd.integrate.duration_derivative import tangents
from torchmbd.integrate.lane_status import validity
from torchmbd.integrate.memory import memory_check
from torchmbd.integrate.motion import Tensors
from torchmbd.integrate.native import backward
from torchmbd.integrate.native.library import with_backend
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.prepared import differentiable
from torchmbd.integrate.retries import integrate_by_chosen_steps, integrate_lanes
from torchmbd.math.pair import Pair
from torchmbd.multibody.system import Dynamics, System
from torchmbd.multibody.system.expansion import Expansion
from torchmbd.results.history import History
from torchmbd.results.motion_data import has_failed


@dataclass(eq=False)
class ReverseIntegration:
    """Equal steps over a duration [s].

    system           the mechanism, or None where steps are given
    model            topology and options of its equations; its data are not used
    names            of the inputs;  duration_is_input: whether the duration is one as well
    steps            their number; None: chosen from the data
    integrator       with a pullback of its steps
    with_gradients   whether derivatives may be taken
    backend          of the steps, as of `simulate`
    differentiated   names of inputs that are, as far as known before the integration: the initial state is then made once

    Results: dynamics, history, status, stats.
    """

    system: System | None
    model: Dynamics
    names: tuple[str, ...]
    duration: float
    duration_is_input: bool
    steps: int | None
    integrator: OneStep
    with_gradients: bool
    backend: str = "auto"
    differentiated: tuple[str, ...] = ()
    dynamics: Dynamics = field(init=False)
    history: History = field(init=False)
    status: list[str] = field(init=False)
    validity: Tensor = field(init=False)
    stats: dict[str, Any] = field(init=False)
    variables: tuple[str, ...] = ()  # none carries tangents along
    _of_leaves: Dynamics | None = field(default=None, init=False, repr=False)  # the dynamics as a function of leaves

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_of_leaves": None}  # has a graph of torch

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """As of `Integration`."""
        data = inputs[: len(self.names)]
        if self.duration_is_input and inputs[-1].shape[-1] > 1:
            raise InputError("duration is a batch of torch.vmap; allowed: one duration for all designs")
        if self.duration_is_input and self.integrator.checkpoint > 1:
            raise InputError(
                f"duration requires a gradient and checkpoint is {self.integrator.checkpoint}; allowed: checkpoint=1"
            )
        self.dynamics = with_backend(self._with(data), self.backend, also=["adjoint"])
        if self.differentiated:
            self._of_leaves = differentiable(self.dynamics, self.differentiated)
        dynamics = self._of_leaves or self.dynamics
        args = self.integrator, dynamics, self.duration
        if self.steps is None:
            assert self.system is not None
            check_memory = memory_check(self.system, dynamics.lanes, 0, self.integrator)
            self.steps, results = integrate_by_chosen_steps(*args, self.with_gradients, check_memory)
        else:
            results = integrate_lanes(*args, self.steps, self.with_gradients)
        h = self.history = results.history
        self.stats, self.status = results.statistics, results.status
        self.validity = validity(h, self.status, self.stats)
        self.dynamics.share_rank(dynamics)
        self.dynamics.evaluate_rank()
        return *h.states, self.validity, *h.at_steps()

    def tangents(self, directions: Tensors) -> list[Tensor]:
        """As of `Integration`."""
        given = zip(self.names, directions[: len(self.names)], strict=True)
        data, parts = self.dynamics.data, []
        moving = {name: Pair.of(data[name], dx) for name, dx in given if dx is not None}
        if moving:
            moved = replace(self._with({**data, **moving}.values()), backend=self.dynamics.backend)
            assert self.steps is not None
            results = integrate_lanes(self.integrator, moved, self.duration, self.steps, with_gradients=True)
            self.stats["tangent_error"] = results.statistics.get("tangent_error")
            h = results.history
            parts.append([x[:, :, 1:] for x in (*h.states, *h.at_steps()[:4])])
        if self.duration_is_input and directions[-1] is not None:
            parts.append([x * directions[-1] for states in self.by_duration for x in states[:4]])
        found = [torch.where(self.validity[1] > 0.0, sum(x), 0.0) for x in zip(*parts, strict=True)]
        counts, rest = self.validity.new_zeros(1, found[0].shape[2], len(self.status)), found[4:]
        return [*found[:4], counts.expand(2, -1, -1), *rest, *([counts] if rest else [])]

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        """As of `Integration`."""
        names = [name for name, one in zip(self.names, needs_grad, strict=False) if one]
        of_times, of_steps = outputs[:4], outputs[5:9] or (None,) * 4
        found = self.adjoint(of_times, names, of_steps) if names else {}
        result = [found.get(name) for name in self.names]
        if self.duration_is_input:
            pairs = [
                *zip(of_times, self.by_duration[0], strict=True),
                *zip(of_steps, self.by_duration[1], strict=False),
            ]
            both = [(bar, dx) for bar, dx in pairs if bar is not None]
            parts = [torch.einsum("tnrl,tnl->rl", bar, dx.squeeze(2)) for bar, dx in both]
            result.append(torch.stack(parts).sum(0) if parts else None)
        return result

    @cached_property
    def by_duration(self) -> tuple[list[Tensor], list[Tensor]]:
        """Derivatives of the states by the duration, as of `duration_derivative.tangents`, by operators of torch."""
        self.stats["gradient by the duration"] = "eager"
        return tangents(self.adjoint.grids(), self.integrator, self.history)

    @cached_property
    def adjoint(self) -> Adjoint:
        """Of the motion."""
        failed = [lane for lane, status in enumerate(self.status) if has_failed(status)]
        args = self.dynamics, self.history, self.duration, self.integrator, failed
        return Adjoint(*args, backward.adjoint_solver, self._of_leaves)

    def expansion(self, data: dict[str, Any]) -> Expansion | None:
        """Leads from the condensed to the whole system, as a function of the data; None: it is the whole."""
        return self.history.expansion_by(data)

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor:
        """All multipliers [times, rows, 1, lanes]; of redundant rows those of least norm."""
        return history.least_norm_multipliers(self.dynamics.least_norm, self.duration, data)

    def _with(self, inputs: Any) -> Dynamics:
        return replace(self.model, data=dict(zip(self.names, inputs, strict=True)))
