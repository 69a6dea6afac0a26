"""Degrees to radians: the one place where degrees enter.

    theta = pi / 180 * degrees

Everything inside torchmbd is in radians; config files and people speak degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def deg(degrees: float | Sequence[float] | Tensor) -> Tensor:
    """Turn degrees into radians, as a float64 tensor of the same shape."""
    return torch.as_tensor(degrees, dtype=torch.float64) * (math.pi / 180.0)
