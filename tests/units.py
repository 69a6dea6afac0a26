"""Systems of units, for tests of models whose numbers are stated in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class Units:
    """Numbers of the meter, the kilogram and the second."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    def __call__(self, x: Any, length: float = 0.0, mass: float = 0.0, time: float = 0.0) -> Any:
        """The number, or the nested list, of SI numbers x of a quantity with these powers of length, mass and time."""
        return (self.factor(length, mass, time) * torch.as_tensor(x, dtype=torch.float64)).tolist()

    def factor(self, length: float = 0.0, mass: float = 0.0, time: float = 0.0) -> float:
        """What SI numbers are multiplied by."""
        return self.length**length * self.mass**mass * self.time**time
