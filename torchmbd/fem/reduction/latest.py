"""Results of the latest designs. The checks of a body, its warnings and its first motion ask for the same modes and factors.

Only results of single designs are kept, one for each of the last BODIES bodies: the next design replaces the one before.
Checked in tests/fem/reduction/test_latest.py.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

import torch
from torch import Tensor

BODIES = 4  # a mechanism has few large bodies, and a factor of one of 100,000 freedoms takes 0.3 GB

Result = TypeVar("Result")


class Latest(Generic[Result]):
    """The results of the last `BODIES` questions of different keys."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, tuple[tuple[Tensor, ...], Result]] = OrderedDict()

    def __call__(self, key: Hashable, numbers: tuple[Tensor, ...], result: Callable[[], Result]) -> Result:
        """Return what is kept for a key and equal numbers [lane, ...], else `result()`; several lanes are not kept."""
        if any(len(x) > 1 for x in numbers):
            return result()
        before, kept = self._kept.get(key, ((), None))
        if kept is not None and all(map(torch.equal, before, numbers)):
            return kept
        self._kept.pop(key, None)
        del kept  # memory for what is made
        made = result()
        self._kept[key] = tuple(x.detach().clone() for x in numbers), made
        self._kept.move_to_end(key)
        while len(self._kept) > BODIES:
            self._kept.popitem(last=False)
        return made
