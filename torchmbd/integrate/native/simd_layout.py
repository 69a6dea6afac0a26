"""Numbers of a batch as compiled code takes them: blocks of LANES lanes, each together.

Checked in tests/integrate/native/test_steps.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchmbd.math.pair import Pair
from torchmbd.multibody.system.topology import Prescribed, Topology

# One vector of AVX: of the lanes of a single design three are idle; twice as many make no batch faster, but a single design of
# ten or more bodies half as fast.
LANES = 4


def blocks(x: Tensor) -> Tensor:
    """Numbers [n, pair, lanes] as [block, 1 + n_b, n, LANES]; the last lane fills the last block."""
    missing = -x.shape[-1] % LANES
    if missing:
        x = torch.cat([x, x[..., -1:].expand(*x.shape[:-1], missing)], -1)
    return x.unflatten(-1, (-1, LANES)).permute(2, 1, 0, 3).contiguous()


def lanes_out(x: Tensor, lanes: int) -> Tensor:
    """The inverse of `blocks`."""
    return x.permute(2, 1, 0, 3).flatten(2)[..., :lanes]


def addresses(arrays: Sequence[Tensor | None]) -> list[int | None]:
    """Addresses of arrays, which compiled code takes for doubles without gaps."""
    assert all(x is None or (x.is_contiguous() and x.dtype == torch.float64) for x in arrays)
    return [None if x is None else x.data_ptr() for x in arrays]


def in_all_lanes(x: Tensor, lanes: int) -> Tensor:
    """A number [..., 1] or [..., lanes] with all lanes."""
    return x.expand(*x.shape[:-1], lanes)


def varied_blocks(T: Topology, schedule: Sequence[Prescribed], lanes: int, n_b: int) -> Tensor:
    """What laws with design variables prescribe [times, block, 1 + n_b, n, LANES]."""
    if not T.varying_primitives:
        return torch.zeros(len(schedule), 0, 0, 0, LANES, dtype=torch.float64)
    return torch.stack([blocks(x) for x in varied_numbers(T, schedule, lanes, n_b)])


def varied_numbers(T: Topology, schedule: Sequence[Prescribed], lanes: int, n_b: int) -> Tensor:
    """What laws with design variables prescribe [times, n, 1 + n_b, lanes]."""
    if not T.varying_primitives:
        return schedule[0].A.new_zeros(len(schedule), 0, 1 + n_b, lanes)

    def numbers(prescribed: Prescribed) -> Tensor:
        parts = [x.full if isinstance(x, Pair) else x for i in T.varying_primitives for x in prescribed.laws[i] or ()]
        wide = [torch.cat([x, x.new_zeros(len(x), 1 + n_b - x.shape[1], x.shape[2])], 1) for x in parts]
        return torch.cat([in_all_lanes(x, lanes) for x in wide])

    return torch.stack([numbers(prescribed) for prescribed in schedule])


def uniform(weights: Tensor, schedule: Sequence[Prescribed]) -> Tensor:
    """Weights and prescribed numbers that all lanes share at each step [steps, n]."""
    steps = [(x.A, x.r, x.t, *(part for law in x.laws if law is not None for part in law)) for x in schedule]
    parts = [torch.stack(part).reshape(len(schedule), -1) for part in zip(*steps, strict=True)]
    return torch.cat([weights.expand(len(schedule), -1), *parts], 1)


def without_varied(T: Topology, schedule: Sequence[Prescribed]) -> Sequence[Prescribed]:
    """Prescribed numbers without those of laws with design variables, which `varied_blocks` has."""
    varied = T.varying_primitives
    return [prescribed.without_laws(varied) for prescribed in schedule] if varied else schedule
