"""The equilibrium of an exact beam as an operation of torch.

The search (continuation.py) has no derivatives. One more step of Newton's method with the exact stiffness, which does not
change the equilibrium, has the derivatives of the implicit function theorem, forward and reverse:

    dq = K^-1 dr,    r(q, b) = 0

Checked in tests/fem/exact_beam/test_gradients.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.linalg
import torch
from torch import Tensor

from torchmbd.fem.exact_beam.continuation import Continuation, Path
from torchmbd.fem.exact_beam.data import RANKS, BeamData, batch_as_lane
from torchmbd.fem.exact_beam.forces import residual, rotated
from torchmbd.math.gradients import is_differentiated


def solve(search: Continuation, data: BeamData) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return positions x [*lanes, n, 3] and rotations R of the nodes (nan without equilibrium), factor and code [*lanes]."""
    derivatives = any(is_differentiated(x) for x in data)
    x, R, inverse, factor, code = _Search.apply(search, derivatives, *data)
    if not derivatives:
        return x, R, factor, code
    topology, n = search.topology, x.shape[-2]
    still = torch.ones(6 * n, dtype=torch.bool)
    still[topology.free] = False
    x = torch.where(still.reshape(n, 6)[:, :3], data.nodes + data.imposed[..., :3], x)
    missing = residual(data, topology, x, R).flatten(-2)
    move = torch.zeros_like(missing).index_copy(
        -1, topology.free, (inverse @ missing[..., topology.free, None])[..., 0]
    )
    move = move.unflatten(-1, (n, 6))
    return x + move[..., :3], rotated(R, move[..., 3:]), factor, code


class _Search(torch.autograd.Function):
    """x, R, K^-1 (of free degrees of freedom; empty without `derivatives`), factor, code of each lane; not differentiable."""

    @staticmethod
    def forward(search: Continuation, derivatives: bool, *data: Tensor) -> tuple[Tensor, ...]:
        batch = BeamData(*(x.detach() for x in data))
        search.paths = [search.run(lane) for lane in batch.split_lanes()]
        rows = [_lane_result(path, derivatives) for path in search.paths]
        return tuple(
            torch.stack(column).reshape((*batch.lanes, *column[0].shape)) for column in zip(*rows, strict=True)
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Any:
        return (None,) * 5

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        return (None,) * (2 + len(RANKS))

    @staticmethod
    def vmap(info: Any, in_dims: tuple, search: Continuation, derivatives: bool, *data: Tensor) -> Any:
        wide = batch_as_lane(info.batch_size, in_dims[2:], data, RANKS)
        return _Search.apply(search, derivatives, *wide), (0,) * 5


def _lane_result(path: Path, derivatives: bool) -> tuple[Tensor, ...]:
    fine = path.code == 0
    x, R = (y if fine else torch.full_like(y, torch.nan) for y in (path.x, path.R))
    size = len(path.K.indptr) - 1 if derivatives else 0
    inverse = np.full((size, size), np.nan)
    if fine and size:
        inverse = scipy.sparse.linalg.splu(path.K.tocsc()).solve(np.eye(size))
    number = path.x.new_tensor
    return x, R, torch.from_numpy(inverse), number(path.factor), torch.tensor(path.code)
