"""The last steps of lanes whose phase an event ends: of the size at which its function vanishes.

    h* : g(t + h*, x(h*)) = 0           dh*/db = -g_b / g_h

The size is found from values alone, between two that enclose it. One more step of that size, with tangents by the design and
by the size, gives the derivatives.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize.elementwise import find_root
from torch import Tensor

from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.phases.events import Event, Views
from torchmbd.integrate.phases.lanes import lanes_of, pick_states, put_states
from torchmbd.integrate.phases.phase_record import PhaseExit, PhaseRecord
from torchmbd.integrate.variable_step import narrowed, widened, widened_data
from torchmbd.math.pair import Pair, value
from torchmbd.results.state import State

_ROUND = 1e-13  # of the size
_MOST = 100  # iterations: a function that jumps takes about 50


class Bracket(NamedTuple):
    """Sizes [lanes] between which the function changes its sign, and the function g_low at the lower ones."""

    low: Tensor
    high: Tensor
    g_low: Tensor


def located(
    event: Event,
    lanes: Sequence[int],
    base: PhaseExit,
    bracket: Bracket,
    record: PhaseRecord,
    integrator: Integrator,
    views: Views,
) -> tuple[PhaseExit, Tensor]:
    """Where the event's function of some lanes vanishes after their bases, and which lanes found it.

    base, bracket   of these lanes
    """
    size, enclosed, near = _sizes(event, lanes, base, bracket, record, integrator, views)
    whole, condensed = (widened_data(lanes_of(d, lanes)) for d in (record.dynamics, record.condensed))
    h = widened(widened(size[None], base.t.shape[0] - 1) if isinstance(base.t, Pair) else size[None])
    h.full[-1] = 1.0  # its own direction
    x, end = base.x.map(widened), widened(base.t) + h
    y = integrator.step_of_size(condensed, x, h, end, near)
    _, slope = views.slopes(event, lanes, whole, end, record.whole(y, end))
    rate = -slope[:-1] / slope[-1]
    end = narrowed(end, rate)
    return PhaseExit(end, record.whole(y.map(lambda z: narrowed(z, rate)), end)), enclosed & finite_lanes(y)


def _sizes(
    event: Event,
    lanes: Sequence[int],
    base: PhaseExit,
    bracket: Bracket,
    record: PhaseRecord,
    integrator: Integrator,
    views: Views,
) -> tuple[Tensor, Tensor, State]:
    """Sizes [lanes] at which the function vanishes, which were found, and states there; values alone."""
    whole, condensed = (lanes_of(d, lanes).values() for d in (record.dynamics, record.condensed))
    start, t = base.x.values(), value(base.t)
    low, high, g_low = bracket
    near, sign = start, g_low.sign()

    def function(sizes: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        nonlocal near
        some, h = numbers.astype(int).tolist(), torch.from_numpy(np.array(sizes))
        g, inner = g_low[some].clone(), h > low[some]
        if bool(inner.any()):
            some, h = [k for k, is_inner in zip(some, inner.tolist(), strict=True) if is_inner], h[inner]
            end = t[:, some] + h
            y = integrator.step_of_size(
                lanes_of(condensed, some), pick_states(start, some), h[None], end, pick_states(near, some)
            )
            near = put_states(near, some, y)
            at_end = views.value(event, [lanes[k] for k in some], lanes_of(whole, some), end, record.whole(y, end))
            # At the end of the regular step it has passed zero, but for rounding.
            beyond = (h >= high[some]) & (at_end * sign[some] > 0.0)
            g[inner] = torch.where(beyond, 0.0, at_end)
        return g.numpy()

    tolerances = {"xatol": 0.0, "xrtol": _ROUND, "fatol": 0.0, "frtol": 0.0}
    numbers = np.arange(len(lanes), dtype=float)
    root = find_root(function, (low.numpy(), high.numpy()), args=(numbers,), tolerances=tolerances, maxiter=_MOST)
    return torch.from_numpy(np.array(root.x)), torch.from_numpy(np.array(root.success)), near


def finite_lanes(x: State) -> Tensor:
    """Which lanes of a state are finite [lanes]."""
    return torch.isfinite(value(x.vd)).flatten(0, 1).all(0)
