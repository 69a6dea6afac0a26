"""Numbers of a batch as compiled code takes them: blocks of eight lanes, each together.

Checked in tests/integrators/test_compiled.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.numerics.pair import Pair, value
from torchmbd.system.dynamics import Dynamics

LANES = 8


def blocks(x: Tensor) -> Tensor:
    """Numbers [n, slots, lanes] as [block, slots, n, 8]; the last lane fills the last block."""
    missing = -x.shape[-1] % LANES
    if missing:
        x = torch.cat([x, x[..., -1:].expand(*x.shape[:-1], missing)], -1)
    return x.unflatten(-1, (-1, LANES)).permute(2, 1, 0, 3).contiguous()


def lanes_out(x: Tensor, lanes: int) -> Tensor:
    """The inverse of `blocks`."""
    return x.permute(2, 1, 0, 3).flatten(2)[..., :lanes]


def addresses(arrays: Sequence[Tensor | None]) -> list[int | None]:
    """Where arrays begin: compiled code believes that they are doubles without gaps."""
    assert all(x is None or (x.is_contiguous() and x.dtype == torch.float64) for x in arrays)
    return [None if x is None else x.data_ptr() for x in arrays]


def in_all_lanes(x: Tensor, lanes: int) -> Tensor:
    """A number that holds for all lanes, once for each."""
    return x.expand(*x.shape[:-1], lanes)


def data_blocks(dynamics: Dynamics) -> tuple[Tensor, Tensor]:
    """Data in the order of their names: values [block, 1, n, 8] and tangents [block, n_b, n, 8]."""
    lanes, slots = dynamics.lanes, dynamics.tangents
    parts = [dynamics.data[name] for name in sorted(dynamics.data)]
    values = torch.cat([in_all_lanes(value(x).reshape(-1, 1, value(x).shape[-1]), lanes) for x in parts])

    def tangents(x: Any) -> Tensor:
        if isinstance(x, Pair):
            return in_all_lanes(x.tangent.reshape(-1, *x.tangent.shape[-2:]), lanes)
        return x.new_zeros(x.shape[:-2].numel(), slots, lanes)

    return blocks(values), blocks(torch.cat([tangents(x) for x in parts]))
