"""Rows of numbers in time [times, rows, pair, lanes], with a derivative that copies them once.

    y = x[:, rows]            x' = 0 but x'[:, rows] = y'

The backward pass of torch's indexing fills arrays of the size of x and adds them, for all directions of torch.vmap in front.
Here these directions lie between rows and lanes, as in the adjoint of a motion, and groups of lanes are written by threads.
Differentiable, forward and reverse, any number of times. Checked in tests/math/test_row_selection.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.gradients import refuse_batched_by_grad
from torchmbd.math.threads import lane_groups, map_threads


def select_rows(x: Tensor, rows: Sequence[int] | Tensor) -> Tensor:
    """Rows of x [times, k, pair, lanes]."""
    rows = torch.as_tensor(rows, dtype=torch.long)
    if len(rows.unique()) < len(rows):  # cotangents of a row that is there twice are summed
        return x.index_select(1, rows)
    return _Selected.apply(x, rows)  # pyright: ignore[reportReturnType]


def lanes_first(x: Tensor) -> Tensor:
    """Numbers [times, k, 1, lanes] as [lanes, times, k], contiguous."""
    return _LanesFirst.apply(x)  # pyright: ignore[reportReturnType]


class _Selected(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor, rows: Tensor) -> Tensor:
        return x.index_select(1, rows)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        x, ctx.rows = inputs
        ctx.count = x.shape[1]

    @staticmethod
    def jvp(ctx: Any, dx: Tensor, _: None) -> Any:
        return _Selected.apply(dx, ctx.rows)

    @staticmethod
    def backward(ctx: Any, *dy: Tensor) -> Any:
        refuse_batched_by_grad(dy)
        return _Spread.apply(dy[0], ctx.rows, ctx.count), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, x: Tensor, rows: Tensor) -> Any:
        y: Any = _Selected.apply(x.movedim(in_dims[0], 2).flatten(2, 3), rows)
        return y.unflatten(2, (info.batch_size, -1)), 2


class _Spread(torch.autograd.Function):
    """(y [times, rows, pair, lanes], rows, k) -> [times, k, pair, lanes], zero in other rows."""

    @staticmethod
    def forward(y: Tensor, rows: Tensor, count: int) -> Tensor:
        y = y.detach()  # as in _LanesFirst
        times, _, pair, lanes = y.shape
        result = y.new_empty(times, count, pair, lanes)
        others = torch.ones(count, dtype=torch.bool)
        others[rows] = False
        empty = others.nonzero()[:, 0]

        def write(group: slice) -> None:
            part = result[..., group]
            part[:, empty] = 0.0
            part[:, rows] = y[..., group]

        map_threads(write, lane_groups(lanes))
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        _, ctx.rows, ctx.count = inputs

    @staticmethod
    def jvp(ctx: Any, dy: Tensor, _: None, __: None) -> Any:
        return _Spread.apply(dy, ctx.rows, ctx.count)

    @staticmethod
    def backward(ctx: Any, *dx: Tensor) -> Any:
        return _Selected.apply(dx[0], ctx.rows), None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, y: Tensor, rows: Tensor, count: int) -> Any:
        x: Any = _Spread.apply(y.movedim(in_dims[0], 2).flatten(2, 3), rows, count)
        return x.unflatten(2, (info.batch_size, -1)), 2


class _LanesFirst(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor) -> Tensor:
        y = x.detach().squeeze(2).permute(2, 0, 1)  # without a tangent, which other threads would propagate
        result = y.new_empty(y.shape)
        map_threads(lambda group: result[group].copy_(y[group]), lane_groups(len(y)))
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        """Keep nothing."""

    @staticmethod
    def jvp(ctx: Any, dx: Tensor) -> Any:
        return _LanesFirst.apply(dx)

    @staticmethod
    def backward(ctx: Any, *dy: Tensor) -> Any:
        return dy[0].permute(1, 2, 0).unsqueeze(2)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, x: Tensor) -> Any:
        y: Any = _LanesFirst.apply(x.movedim(in_dims[0], -2).flatten(-2, -1))
        return y.unflatten(0, (info.batch_size, -1)), 0
