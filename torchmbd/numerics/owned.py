"""Arrays given by a user, read as tensors of one's own: a later change of the argument changes nothing here.

Checked in tests/numerics/test_owned.py.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchmbd.errors import InputError


def reals(name: str, given: ArrayLike | Tensor) -> Tensor:
    """Read numbers of any shape as float64; InputError names the argument."""
    return _read(name, given, "numbers").double()


def indices(name: str, given: ArrayLike | Tensor) -> Tensor:
    """Read whole numbers of any shape as int64; InputError names the argument and the number."""
    x = _read(name, given, "whole numbers")
    broken = (x != x.round()).flatten() if x.is_floating_point() else torch.zeros(0, dtype=torch.bool)
    if broken.any():
        raise InputError(f"{name} holds {float(x.flatten()[broken][0])!r}; allowed: whole numbers")
    return x.long()


def _read(name: str, given: ArrayLike | Tensor, allowed: str) -> Tensor:
    try:
        return (given.detach() if isinstance(given, Tensor) else torch.from_numpy(np.array(given))).clone()
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is {given!r}; allowed: {allowed}") from error
