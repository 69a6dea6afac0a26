"""Objects made of tensors, with all of these on another device.

Checked in tests/integrators/test_device.py.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

from torchmbd.numerics.pair import Pair


def placed(x: Any, device: torch.device, leave: tuple[type, ...] = (), _seen: dict[int, Any] | None = None) -> Any:
    """A copy of x with its tensors, and those of objects of this package that it is made of, on a device.

    leave   kinds of objects that stay what they are
    """
    seen = {} if _seen is None else _seen

    def moved(y: Any) -> Any:
        return placed(y, device, leave, seen)

    if isinstance(x, leave):
        return x
    if isinstance(x, Tensor):
        return x.to(device)
    if isinstance(x, Pair):
        return Pair(x.full.to(device))
    if isinstance(x, dict):
        return {key: moved(y) for key, y in x.items()}
    if isinstance(x, (list, tuple)):
        parts = [moved(y) for y in x]
        return type(x)(*parts) if hasattr(x, "_fields") else type(x)(parts)
    if not type(x).__module__.startswith("torchmbd.") or not hasattr(x, "__dict__"):
        return x
    if id(x) not in seen:  # what two objects share they share there as well
        seen[id(x)] = there = copy.copy(x)
        there.__dict__.update({name: moved(y) for name, y in vars(x).items()})
    return seen[id(x)]
