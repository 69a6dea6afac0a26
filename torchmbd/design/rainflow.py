"""Cycles of a history by rainflow counting.

    range_k = |y_i - y_j|,  mean_k = (y_i + y_j) / 2,  count_k = 1 or 1/2        (i, j): the two turning points of cycle k

Which points form a cycle is found from the values alone and has no derivative; ranges and means are differentiable in y.
They are exact wherever a small change of y leaves the ranking of the ranges as it is.
Source: ASTM E1049-85 (2017), section 5.4.4.
Checked in tests/design/test_fatigue.py: the example of the standard.
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

    y   [..., n], a tensor or what makes one; a history with values that are not finite has ranges and means that are nan

    >>> cycles = mbd.rainflow([-2.0, 1, -3, 5, -1, 3, -4, 4, -2])
    >>> sorted({float(r): float(cycles.count[cycles.range == r].sum()) for r in cycles.range if r}.items())
    [(3.0, 0.5), (4.0, 1.5), (6.0, 0.5), (8.0, 1.0), (9.0, 0.5)]
    """
    if not isinstance(y, Tensor):
        y = reals("y", y)
    y = y if y.is_floating_point() else y.double()
    if y.dim() < 1 or y.shape[-1] < 2:
        raise InputError(f"a history has the shape {tuple(y.shape)}; allowed: [..., n] with two values at least")
    first, second, count = _Pairs.apply(y)  # pyright: ignore[reportGeneralTypeIssues]
    # Cycles of a part of a history would be a number made up.
    y = torch.where(y.isfinite().all(-1, keepdim=True), y, torch.nan)
    a, b = y.gather(-1, first), y.gather(-1, second)
    return Cycles((a - b).abs(), 0.5 * (a + b), count)


class _Pairs(torch.autograd.Function):
    """Places of both turning points of every cycle, and its count: constants, found from plain numbers."""

    @staticmethod
    def forward(y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        flat = y.detach().reshape(-1, y.shape[-1]).cpu().numpy()
        found = (torch.from_numpy(x).to(y.device) for x in pairs(flat))
        first, second, count = (x.reshape(*y.shape[:-1], y.shape[-1] - 1) for x in found)
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


def pairs(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of histories [h, n]: places of the two turning points of each cycle, and counts [h, n - 1]; 0 where there is none.

    All histories are counted at the same time: a stack of turning points each, from which closed cycles are taken.
    """
    histories, n = y.shape
    first, second = np.zeros((2, histories, n - 1), dtype=np.int64)
    count, taken = np.zeros((histories, n - 1)), np.zeros(histories, dtype=np.int64)
    stack, size = np.zeros((histories, n), dtype=np.int64), np.zeros(histories, dtype=np.int64)

    def note(rows: np.ndarray, a: np.ndarray, b: np.ndarray, cycles: Any) -> None:
        place = taken[rows]
        first[rows, place], second[rows, place], count[rows, place] = a, b, cycles
        taken[rows] += 1

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
            note(rows, a, b, np.where(starts, 0.5, 1.0))
            half, whole = rows[starts], rows[~starts]
            stack[half, 0], stack[half, 1] = b[starts], c[starts]
            stack[whole, size[whole] - 3] = c[~starts]
            size[half] -= 1
            size[whole] -= 2
    for k in range(1, int(size.max(initial=0))):
        rows = np.flatnonzero(size > k)
        note(rows, stack[rows, k - 1], stack[rows, k], 0.5)
    return first, second, count


def turning_points(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the ends and of all local extrema of histories [h, n], in order; how many there are [h]."""
    sign = np.sign(np.diff(y, axis=1))
    for k in range(1, sign.shape[1]):  # where a history rests, it goes on as before
        sign[:, k] = np.where(sign[:, k] == 0.0, sign[:, k - 1], sign[:, k])
    turns = np.ones(y.shape, dtype=bool)
    turns[:, 1:-1] = sign[:, :-1] * sign[:, 1:] < 0.0
    return np.argsort(~turns, axis=1, kind="stable"), turns.sum(1)
