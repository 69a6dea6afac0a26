"""Cycles of a history by rainflow counting.

    range_k = |y_i - y_j|,  mean_k = (y_i + y_j) / 2,  count_k = 1 or 1/2        (i, j): the two turning points of cycle k

The pairs (i, j) are computed from the values and have no derivative; ranges and means are differentiable in y, exactly where a
small change of y does not change the ranking of the ranges.
Source: ASTM E1049-85 (2017), section 5.4.4.
Checked in tests/extensions/fatigue/test_fatigue.py: the example of the standard.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import reals


class Cycles(NamedTuple):
    """Ranges and means in the unit of the history, and counts: 1, 1/2, or 0 where a history has fewer cycles [..., n - 1]."""

    range: Float[Tensor, "*histories cycles"]
    mean: Float[Tensor, "*histories cycles"]
    count: Float[Tensor, "*histories cycles"]


def rainflow(y: Any) -> Cycles:
    """Count the cycles of histories `y` with n >= 2 values each, of any unit. Raises InputError for fewer.

    y   [..., n], a tensor or numbers; a history with values that are not finite has ranges and means nan

    >>> cycles = mbd.fatigue.rainflow([-2.0, 1, -3, 5, -1, 3, -4, 4, -2])
    >>> sorted({float(r): float(cycles.count[cycles.range == r].sum()) for r in cycles.range if r}.items())
    [(3.0, 0.5), (4.0, 1.5), (6.0, 0.5), (8.0, 1.0), (9.0, 0.5)]
    """
    if not isinstance(y, Tensor):
        y = reals("y", y)
    y = y if y.is_floating_point() else y.double()
    if y.dim() < 1 or y.shape[-1] < 2:
        raise InputError(
            "y",
            allowed="must have shape [..., n] with at least two values",
            state=f"has the shape {tuple(y.shape)}",
            noun="a history",
        )
    first, second, count = _Pairs.apply(y)  # pyright: ignore[reportGeneralTypeIssues]
    # The cycles of the finite values alone would look like a result.
    y = torch.where(y.isfinite().all(-1, keepdim=True), y, torch.nan)
    a, b = y.gather(-1, first), y.gather(-1, second)
    return Cycles((a - b).abs(), 0.5 * (a + b), count)


class _Pairs(torch.autograd.Function):
    """Indices of both turning points of every cycle, and its count, as constants for autograd and torch.func."""

    @staticmethod
    def forward(y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        flat = y.detach().reshape(-1, y.shape[-1]).cpu().numpy()
        pairs = (torch.from_numpy(x).to(y.device) for x in cycle_pairs(flat))
        first, second, count = (x.reshape(*y.shape[:-1], y.shape[-1] - 1) for x in pairs)
        return first, second, count.to(y.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, y: Tensor) -> tuple:
        return _Pairs.apply(y.movedim(in_dims[0], 0)), (0, 0, 0)

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> tuple[None, None, None]:
        return None, None, None

    @staticmethod
    def backward(ctx: Any, *_: Any) -> None:
        return None


def cycle_pairs(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the two turning points of each cycle, and counts [h, n - 1], 0 for no cycle, of histories [h, n].

    All histories are counted at the same time. Each has a stack of turning points, from which closed cycles are removed.
    """
    histories, n = y.shape
    first, second = np.zeros((2, histories, n - 1), dtype=np.int64)
    count, cycles = np.zeros((histories, n - 1)), np.zeros(histories, dtype=np.int64)
    stack, size = np.zeros((histories, n), dtype=np.int64), np.zeros(histories, dtype=np.int64)

    def record(rows: np.ndarray, a: np.ndarray, b: np.ndarray, counts: Any) -> None:
        k = cycles[rows]
        first[rows, k], second[rows, k], count[rows, k] = a, b, counts
        cycles[rows] += 1

    points, number = turning_points(y)
    for k in range(int(number.max(initial=0))):
        rows = np.flatnonzero(number > k)
        stack[rows, size[rows]] = points[rows, k]
        size[rows] += 1
        while len(rows := rows[size[rows] >= 3]):
            top = size[rows]
            a, b, c = (stack[rows, top - i] for i in (3, 2, 1))
            closed = np.abs(y[rows, c] - y[rows, b]) >= np.abs(y[rows, b] - y[rows, a])
            rows, top, a, b, c = (x[closed] for x in (rows, top, a, b, c))
            starts = top == 3  # the range contains the first point of the history: half a cycle
            record(rows, a, b, np.where(starts, 0.5, 1.0))
            half, whole = rows[starts], rows[~starts]
            stack[half, 0], stack[half, 1] = b[starts], c[starts]
            stack[whole, size[whole] - 3] = c[~starts]
            size[half] -= 1
            size[whole] -= 2
    for k in range(1, int(size.max(initial=0))):
        rows = np.flatnonzero(size > k)
        record(rows, stack[rows, k - 1], stack[rows, k], 0.5)
    return first, second, count


def turning_points(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices [h, n] of histories, first those of ends and local extrema, in order; and how many these are [h]."""
    sign = np.sign(np.diff(y, axis=1))
    for k in range(1, sign.shape[1]):  # a constant part continues the rise or fall before it
        sign[:, k] = np.where(sign[:, k] == 0.0, sign[:, k - 1], sign[:, k])
    turns = np.ones(y.shape, dtype=bool)
    turns[:, 1:-1] = sign[:, :-1] * sign[:, 1:] < 0.0
    return np.argsort(~turns, axis=1, kind="stable"), turns.sum(1)
