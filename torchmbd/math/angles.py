"""Degrees to radians.

    theta = pi / 180 * degrees

All angles inside torchmbd are in radians; config files have degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchmbd.errors import InputError


def deg(degrees: float | Sequence[float] | Tensor) -> Tensor:
    """Turn degrees [deg] into radians [rad], as a float64 tensor of the same shape.

    degrees  a number, numbers in lists, or a tensor, whose gradient is kept

    Raises InputError for anything that is not a number.

    >>> mbd.deg([0, 90])
    tensor([0.0000, 1.5708], dtype=torch.float64)
    """
    try:
        x = torch.as_tensor(degrees, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise InputError("degrees", degrees, "numbers") from error
    return x * (math.pi / 180.0)
