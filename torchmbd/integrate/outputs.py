"""What the operation `Motion` returns, in one order: numbers [component..., 1, lanes], their tangents, or their cotangents.

Checked in tests/integrate/test_motion.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.pair import Pair
from torchmbd.results.history import History
from torchmbd.results.motion_data import Switch

SIDES = ("q", "v", "a", "lam")
OF_SWITCH = 1 + 2 * len(SIDES)  # numbers: the time, and the states on both sides
STATES = 4  # numbers: q, v, v', lam


class Outputs(NamedTuple):
    """Outputs by their meaning.

    states     q, v, v', lam [times, n, ., lanes]
    validity   of the lanes (lane_status.py)
    at_steps   where lanes have smaller steps: the states at these (`History.at_steps`)
    segment    of several segments: that of each state, as in `History`
    data       of the reduced model, by name
    switches   of each the numbers of `switch_numbers`
    """

    states: Sequence[Any]
    validity: Any
    at_steps: Sequence[Any]
    segment: Sequence[Any]
    data: Mapping[str, Any]
    switches: Sequence[Sequence[Any]]

    @classmethod
    def of(cls, h: History, switches: Sequence[Switch], validity: Tensor, data: Mapping[str, Any]) -> Outputs:
        """Of a motion: pairs, or tensors of what has no tangents."""
        at_steps = h.at_steps()
        states = [Pair(x) for x in h.states]
        at_steps = [*(Pair(x) for x in at_steps[:STATES]), *at_steps[STATES:]]
        segment = [] if h.segment is None else [h.segment]
        return cls(states, validity, at_steps, segment, data, [switch_numbers(x) for x in switches])

    @property
    def flat(self) -> list[Any]:
        """In order."""
        return [*self.states, self.validity, *self.at_steps, *self.segment, *self.data.values(), *chain(*self.switches)]

    def like(self, flat: Sequence[Any]) -> Outputs:
        """Other numbers in this order, by their meaning."""
        rest = iter(flat)

        def some(count: int) -> list[Any]:
            return [next(rest) for _ in range(count)]

        states, [validity], at_steps, segment = (some(n) for n in (STATES, 1, len(self.at_steps), len(self.segment)))
        data = dict(zip(self.data, some(len(self.data)), strict=True))
        return Outputs(states, validity, at_steps, segment, data, [some(OF_SWITCH) for _ in self.switches])

    def values(self) -> tuple[Tensor, ...]:
        """Without tangents, in order."""
        return tuple(x.value if isinstance(x, Pair) else x.contiguous() for x in self.flat)

    def tangents(self, count: int) -> list[Tensor]:
        """Tangents alone, in order; count: how many there are."""

        def tangent(x: Any) -> Tensor:
            return x.tangent if isinstance(x, Pair) else x.new_zeros(*x.shape[:-2], count, x.shape[-1])

        return [tangent(x) for x in self.flat]


def switch_numbers(switch: Switch) -> list[Any]:
    """Time and states of a switch as numbers [n, 1 + n_b, lanes]."""

    def number(x: Tensor, dx: Tensor | None) -> Any:
        y = x.T[:, None]
        return Pair(y if dx is None else torch.cat([y, dx.permute(1, 2, 0)], 1))

    t, dt = switch.t[:, None], switch.dt_db
    numbers = [number(t, None if dt is None else dt[:, None])]
    for side in (switch.before, switch.after):
        numbers += [number(getattr(side, name), getattr(side, f"d{name}_db")) for name in SIDES]
    return numbers


def switches_with(switches: Sequence[Switch], numbers: Sequence[Sequence[Tensor]]) -> list[Switch]:
    """The switches with numbers, as in `switch_numbers`, that are differentiable outputs of `Motion`."""
    result = []
    for switch, (t, *states) in zip(switches, numbers, strict=True):
        rows = iter([x[:, 0].T for x in states])
        before, after = (
            replace(side, **{name: next(rows) for name in SIDES}) for side in (switch.before, switch.after)
        )
        result.append(replace(switch, t=t[0, 0], before=before, after=after))
    return result
