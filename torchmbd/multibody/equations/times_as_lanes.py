"""Prescribed quantities of several times in one object: its lanes are the times, or each lane has a time of its own.

`as_lanes`: a whole motion is evaluated at once; for systems without prescribed bodies. `over_times` evaluates it in parts.
`at_own_times`: lanes that pass a switch at different times; these may move with the design. `at_time`: functions of time and
state, f(t, q, v), of all such lanes at once:

    df/db = f_t dt*/db + f_q dq/db + f_v dv/db + f_b

Checked in tests/physics/test_energies.py, tests/results/test_reaction.py, tests/multibody/saddle/test_condensation.py,
tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.forward_mode import jvp
from torchmbd.math.jet import Jet
from torchmbd.math.pair import Pair, linear, value
from torchmbd.multibody.equations.topology import Prescribed, Schedule, Topology

_CHUNK = 2048  # times x lanes in one evaluation


def at_own_times(T: Topology, t: Any, data: Mapping[str, Any]) -> Prescribed:
    """Drives and bodies of known motion of lanes at the times t [1 + n, lanes], with tangents if t has any."""
    now = value(t)[0]
    prescribed = T.prescribed(now, data)
    if not isinstance(t, Pair):
        return prescribed
    laws = [None if law is None else tuple(_moved(x, t) for x in law) for law in T.law_jets(now, data)]
    prescribed = prescribed._replace(laws=laws, t=t)
    if not T.prescribed_bodies:
        return prescribed

    def poses(s: Tensor) -> tuple[Tensor, Tensor]:
        at = T.prescribed(s, data)
        return at.A, at.r

    (A, r), rates = jvp(poses, (now,), (torch.ones_like(now),))[:2]
    return prescribed._replace(A=Pair.of(A, rates[0] * t.tangent), r=Pair.of(r, rates[1] * t.tangent))


def at_time(f: Callable[..., tuple], dynamics: Any, t: Any, *state: Any) -> tuple:
    """f(dynamics, times [lanes], *state) of lanes at times t [1 + n, lanes] that may depend on the design."""
    now = value(t)[0]
    result = f(dynamics, now, *state)
    if not (isinstance(t, Pair) and bool(t.tangent.any())):
        return result
    plain, values = dynamics.values(), [value(x) for x in state]
    _ = plain.rank  # is found once, outside of the derivative
    _, rates = jvp(lambda s: f(plain, s, *values), (now,), (torch.ones_like(now),))[:2]
    return tuple(Pair.of(value(x), x.tangent + rate * t.tangent) for x, rate in zip(result, rates, strict=True))


def _moved(x: Jet, t: Pair) -> Pair:
    """What a law prescribes at a time that depends on the design."""
    moved = value(x.velocity) * t.tangent
    return Pair.of(value(x.value), moved + x.value.tangent if isinstance(x.value, Pair) else moved)


def as_lanes(schedule: Schedule, lanes: int = 1, lanes_first: bool = False) -> Prescribed:
    """Prescribed quantities of all times of a schedule for so many lanes: laws [..., times x lanes], or [..., lanes x times] if
    lanes_first, and t [times]."""

    def wide(x: Tensor) -> Tensor:
        return x.expand(*x.shape[:-1], lanes).movedim(0, -1 if lanes_first else -2).flatten(-2)

    laws: list[tuple | None] = []
    for law in schedule.laws:
        laws.append(law and tuple(Pair(wide(x.full)) if isinstance(x, Pair) else wide(x) for x in law))
    return Prescribed(laws, schedule.A[0], schedule.r[0], schedule.t)


def over_times(f: Callable[..., Any], T: Topology, data: Mapping[str, Any], times: Tensor, *motion: Tensor) -> Tensor:
    """f along a motion [times, component, pair, lanes]: [times, rows, pair, lanes].

    f   of data, prescribed quantities and numbers [component, pair, lanes], all with times x lanes as lanes
    """
    lanes, results = motion[0].shape[-1], []
    for start in range(0, len(times), count := max(1, _CHUNK // lanes)):
        t = times[start : start + count]
        wide = {name: _repeated(x, len(t), lanes) for name, x in data.items()}
        numbers = (x[start : start + count].permute(1, 2, 0, 3).flatten(2) for x in motion)
        pairs = (Pair(x) if x.shape[1] > 1 else x for x in numbers)
        y = f(wide, as_lanes(T.schedule(t, data), lanes), *pairs)
        full = y.full if isinstance(y, Pair) else y
        results.append(full.unflatten(2, (len(t), lanes)).permute(2, 0, 1, 3))
    return torch.cat(results)


def _repeated(x: Any, times: int, lanes: int) -> Any:
    """Data x [component..., pair, lanes or 1], repeated for all times: [component..., pair, times x lanes], or x itself."""
    if not isinstance(x, Pair) and x.shape[-1] == 1:
        return x
    return linear(lambda y: y.expand(*y.shape[:-1], lanes).repeat(*([1] * (y.dim() - 1)), times), x)
