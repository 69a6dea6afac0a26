"""Numbers of a batch as compiled code takes them: blocks of LANES lanes, each together.

Checked in tests/extensions/native/test_steps.py.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchmbd.integrate.adjoint_solver import varied_numbers
from torchmbd.integrate.lanes import expanded
from torchmbd.multibody.equations.topology import Schedule, Topology
from torchmbd.multibody.system.dynamics import Dynamics

# One vector of AVX: of the lanes of a single design three are idle; twice as many make no batch faster, but a single design of
# ten or more bodies half as fast.
LANES = 4


def blocks(x: Tensor) -> Tensor:
    """Numbers [n, pair, lanes] as [block, 1 + n_b, n, LANES]; the last lane fills the last block."""
    missing = -x.shape[-1] % LANES
    if missing:
        x = torch.cat([x, x[..., -1:].expand(*x.shape[:-1], missing)], -1)
    return x.unflatten(-1, (-1, LANES)).permute(2, 1, 0, 3).contiguous()


def unknown_weights(dynamics: Dynamics, lanes: int) -> Tensor:
    """One over the sizes of accelerations and multipliers (sizes.py) [block, 1, n_v + rows, LANES]."""
    return blocks(expanded(dynamics.sizes.unknowns[:, None].reciprocal(), lanes))


def lanes_out(x: Tensor, lanes: int) -> Tensor:
    """The inverse of `blocks`."""
    return x.permute(2, 1, 0, 3).flatten(2)[..., :lanes]


def addresses(arrays: Mapping[str, Tensor | None]) -> dict[str, int | None]:
    """Addresses of arrays by name, which compiled code takes for doubles without gaps."""
    assert all(x is None or (x.is_contiguous() and x.dtype == torch.float64) for x in arrays.values())
    return {name: None if x is None else x.data_ptr() for name, x in arrays.items()}


def varied_blocks(T: Topology, schedule: Schedule, lanes: int, n_b: int) -> Tensor:
    """What laws with design variables prescribe [times, block, 1 + n_b, n, LANES]."""
    if not T.varying_primitives:
        return torch.zeros(len(schedule), 0, 0, 0, LANES, dtype=torch.float64)
    return torch.stack([blocks(x) for x in varied_numbers(T, schedule, lanes, n_b)])


def in_blocks(x: Tensor) -> Tensor:
    """Numbers [...] that all lanes share, as [..., LANES]."""
    return x[..., None].expand(*x.shape, LANES).contiguous()


def prescribed_blocks(T: Topology, weights: Tensor, schedule: Schedule) -> Tensor:
    """Weights and prescribed numbers that all lanes share at each step [steps, n, LANES]; others are in `varied_blocks`."""
    laws = [law for i, law in enumerate(schedule.laws) if law is not None and i not in T.varying_primitives]
    parts = [schedule.A, schedule.r, schedule.t, *(part for law in laws for part in law)]
    numbers = [weights.expand(len(schedule), -1), *(part.reshape(len(schedule), -1) for part in parts)]
    return in_blocks(torch.cat(numbers, 1))
