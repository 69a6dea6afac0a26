"""The rows of a matrix that differ: one column after another is sorted, which is faster than to compare whole rows.

Checked in tests/math/test_distinct_rows.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Int, Shaped
from torch import Tensor


def distinct_rows(x: Shaped[Tensor, "n columns"]) -> tuple[Int[Tensor, " k"], Int[Tensor, " n"]]:
    """Return the first of each k distinct rows, and for each row its number among these, in the order of `torch.unique`."""
    number = torch.zeros(len(x), dtype=torch.long)
    for column in x.unbind(1):
        values, place = torch.unique(column, return_inverse=True)
        number = torch.unique(number * len(values) + place, return_inverse=True)[1]
    count = int(number.max()) + 1 if len(x) else 0
    order = torch.arange(len(x))
    return order.new_full((count,), len(x)).scatter_reduce(0, number, order, "amin"), number
