"""What a response is: a number of every time of a motion, or one number of a whole motion, with its design gradient.

    History   value [lanes, times], gradient [lanes, times, n_b]      strain energy, displacement, ...
    Measure   value [lanes],        gradient [lanes, n_b]             integral, maximum, ... of a history

A history is written on a trajectory with sensitivities: its gradient is the chain rule of eq. (27). A new response is one
small class and one line of the registry in responses.py.

    measure <= limit        is a constraint; limit a number, or "initial": the value of the measure at the initial design
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrators import Trajectory
from torchmbd.system import System


class Valued(NamedTuple):
    """A value with its design gradient; None for a motion without sensitivities."""

    value: Tensor
    gradient: Tensor | None


class History:
    """A number at every time of a motion."""

    def series(self, motion: Trajectory) -> Valued:
        """Value [lanes, times] and gradient [lanes, times, n_b]."""
        raise NotImplementedError(type(self).__name__)

    def check(self, system: System) -> None:
        """Raise InputError where the history asks for what the system does not have."""


class Measure:
    """One number of a motion."""

    def of(self, motion: Trajectory) -> Valued:
        """Value [lanes] and gradient [lanes, n_b], None without sensitivities."""
        raise NotImplementedError(type(self).__name__)

    def check(self, system: System) -> None:
        """Raise InputError where the measure asks for what the system does not have."""

    def value(self, motion: Trajectory) -> Tensor:
        """Value [lanes]."""
        return self.of(motion).value

    def value_and_gradient(self, motion: Trajectory) -> Valued:
        """Value [lanes] and gradient [lanes, n_b]. Raises InputError for a motion without sensitivities."""
        result = self.of(motion)
        if result.gradient is None:
            raise InputError("motion has no sensitivities; allowed: simulate(..., sensitivities=True)")
        return result

    def __le__(self, limit: float | str) -> Constraint:
        return Constraint(self, limit)


@dataclass(frozen=True)
class Constraint:
    """measure <= limit; eq. (37). "initial" is the value of the measure at the initial design."""

    measure: Measure
    limit: float | str

    def __post_init__(self) -> None:
        if not isinstance(self.measure, Measure):
            raise InputError(f"constraint on {self.measure!r}; allowed: a measure, such as Max(StrainEnergy('rod'))")
        if self.limit != "initial" and (
            isinstance(self.limit, (str, bool)) or not abs(float(self.limit)) < float("inf")
        ):
            raise InputError(f"limit of a constraint is {self.limit!r}; allowed: a finite number or 'initial'")
