"""The last steps of lanes whose phase an event ends: of the size at which its function vanishes.

    h* : g(t + h*, x(h*)) = 0           dh*/db = -g_b / g_h

The size is found from values alone, between two that enclose it. One more step of that size, with tangents by the design and
by the size, gives the derivatives.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.lanes import lanes_of, pick_lanes, pick_states, put_states
from torchmbd.integrate.phases.events import Event, Views
from torchmbd.integrate.phases.phase_record import PhaseExit, PhaseRecord
from torchmbd.integrate.variable_step import narrowed, widened, widened_data
from torchmbd.math.pair import Pair, value
from torchmbd.math.roots import roots
from torchmbd.results.state import State


class Bracket(NamedTuple):
    """Sizes [lanes] between which the function changes its sign, and the function there."""

    low: Tensor
    high: Tensor
    g_low: Tensor
    g_high: Tensor


def located(
    event: Event,
    lanes: Sequence[int],
    base: PhaseExit,
    bracket: Bracket,
    record: PhaseRecord,
    integrator: Integrator,
    views: Views,
    h: Any,
    before: Any,
) -> tuple[PhaseExit, Tensor]:
    """Where the event's function of some lanes vanishes after their bases, and which lanes found it.

    base, bracket   of these lanes
    h, before       sizes of regular steps, and of the steps before the last ones [1 + n, lanes]

    With tangents, times at which the function has no rate are nan: they have no derivatives.
    """
    whole, condensed = (lanes_of(d, lanes).values() for d in (record.dynamics, record.condensed))
    start, t = base.x.values(), value(base.t)
    known = value(before)
    near, smooth = start, record.smooth_start(integrator, whole, start, t, value(h))

    def function(size: Tensor, some: list[int]) -> Tensor:
        """The function after steps of some of the lanes; `near` are the states there."""
        nonlocal near
        end, of_some = t[:, some] + size, [lanes[k] for k in some]
        estimate = pick_states(near, some)
        x = smooth.lanes(some).resized(pick_states(start, some), size[None], pick_lanes(known, some))
        y = integrator.step_of_size(lanes_of(condensed, some), x, size[None], end, estimate)
        near = put_states(near, some, y)
        return views.value(event, of_some, lanes_of(whole, some), end, record.whole(y, end))

    low, high, g_low, g_high = bracket
    # An event that passes has passed zero where its step ends, but for rounding.
    g_high = torch.where(g_low * g_high > 0.0, 0.0, g_high)
    size, enclosed = roots(function, low, high, g_low, g_high)
    end = t + size
    if not isinstance(base.t, Pair):  # the step that has tangents where there are some: the same to the last digit
        y = integrator.step_of_size(condensed, smooth.resized(start, size[None], known), size[None], end, near)
        return PhaseExit(end, record.whole(y, end)), enclosed & finite_lanes(y)
    whole, condensed = (widened_data(lanes_of(d, lanes)) for d in (record.dynamics, record.condensed))
    size = widened(widened(size[None], base.t.shape[0] - 1))
    size.full[-1] = 1.0  # its own direction
    x, end = base.x.map(widened), widened(base.t) + size
    smooth = record.smooth_start(integrator, whole, x, widened(base.t), widened(h))
    y = integrator.step_of_size(condensed, smooth.resized(x, size, widened(before)), size, end, near)
    _, slope = views.slopes(event, lanes, whole, end, record.whole(y, end))
    rate = -slope[:-1] / slope[-1]
    end = narrowed(end, rate)
    success = enclosed & finite_lanes(y)
    end = end + torch.where(slope[-1] == 0.0, torch.nan, 0.0)
    return PhaseExit(end, record.whole(y.map(lambda z: narrowed(z, rate)), end)), success


def without_rate(phase: str) -> InputError:
    """The error for an event whose time has no derivative."""
    return InputError(
        ("phases", phase, "until"),
        allowed="a function that crosses zero with a rate",
        noun=f"the function of the event of phase {phase!r}",
        state="has no rate at its event, so that the time of the event has no derivative",
        hint="gradients='none'",
    )


def finite_lanes(x: State) -> Tensor:
    """Which lanes of a state are finite [lanes]."""
    return torch.isfinite(value(x.vd)).flatten(0, 1).all(0)
