"""Lanes of numbers, states and dynamics: some of them, and several joined.

Numbers [..., lanes] are tensors or pairs.
Checked in tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.pair import Pair
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


def pick_lanes(x: Any, lanes: Sequence[int]) -> Any:
    """Some lanes of a number [..., lanes]; itself where these are all of them in their order."""
    if list(lanes) == list(range(x.shape[-1])):
        return x
    index = torch.tensor(list(lanes), dtype=torch.long)
    return Pair(x.full.index_select(-1, index)) if isinstance(x, Pair) else x.index_select(-1, index)


def pick_states(x: State, lanes: Sequence[int]) -> State:
    """The state of some lanes."""
    return x.map(lambda y: pick_lanes(y, lanes))


def put_lanes(x: Any, lanes: Sequence[int], y: Any) -> Any:
    """The number x [..., lanes] with other numbers y in some lanes; y where these are all of them in their order."""
    if list(lanes) == list(range(x.shape[-1])):
        return y
    index = torch.tensor(list(lanes), dtype=torch.long)
    return Pair(x.full.index_copy(-1, index, y.full)) if isinstance(x, Pair) else x.index_copy(-1, index, y)


def join_lanes(parts: Sequence[Any]) -> Any:
    """Several numbers [..., lanes] as one, with the lanes of all."""
    if isinstance(parts[0], Pair):
        return Pair(torch.cat([x.full for x in parts], -1))
    return torch.cat(list(parts), -1)


def join_states(states: Sequence[State]) -> State:
    """Several states as one, with the lanes of all."""
    q, v, vd, a, lam = (join_lanes(x) for x in zip(*states, strict=True))
    return State(q, v, vd, a, lam)


def put_states(x: State, lanes: Sequence[int], y: State) -> State:
    """The state of all lanes with another one in some of them."""
    q, v, vd, a, lam = (put_lanes(old, lanes, new) for old, new in zip(x, y, strict=True))
    return State(q, v, vd, a, lam)


def lane_numbers(mask: Tensor) -> list[int]:
    """The lanes where a mask [lanes] is true."""
    return torch.nonzero(mask)[:, 0].tolist()


def lanes_of(dynamics: Dynamics, lanes: Sequence[int]) -> Dynamics:
    """The dynamics of some lanes; with the rank of all, once it is known."""
    some = dynamics.select_lanes(lanes)
    if some is not dynamics:
        some = replace(some, statistics=dynamics.statistics)
        if dynamics.known_rank is not None:
            some.known_rank = dynamics.known_rank
    return some


def expanded(x: Tensor, lanes: int) -> Tensor:
    """A tensor [..., lanes or 1] with so many lanes."""
    return x.expand(*x.shape[:-1], lanes)
