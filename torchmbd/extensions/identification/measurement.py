"""The contract of a measurement: what the model shows of it, with exact derivatives, and what was measured.

    prediction(b)       numbers of the model in the order of the blocks, and their derivatives
    r = (prediction - measured) / deviation        the residuals that `identify` makes small

A measurement is one file here, and one line of MEASUREMENTS in registry.py. The generic tests in
tests/extensions/identification/test_measurements.py run over these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn

from torchmbd.extensions.identification.run import Run
from torchmbd.multibody.system import System

Limits = Mapping[str, tuple[float, float]]  # bounds of the unknowns of a measurement, by name


@dataclass(frozen=True, eq=False)
class Block:
    """Numbers of one channel of a measurement.

    channel    its name
    x          what they are over: times [s], loads, numbers of modes [rows]
    measured   [rows], SI
    deviation  standard deviation [rows]; None: estimated from the residuals
    title      response and unit;   abscissa: what x is
    count      numbers that were left out, and why
    note       what a user must know of this block, "" where there is nothing
    """

    channel: str
    x: np.ndarray
    measured: np.ndarray
    deviation: np.ndarray | None
    title: str
    abscissa: str = "time [s]"
    note: str = ""


@dataclass(frozen=True)
class Prediction:
    """Numbers of the model for a batch of designs.

    value        [lanes, rows]
    by_design    derivative with respect to the variables of the run [lanes, rows, n_b]; None without gradients
    by_unknown   derivative with respect to own unknowns of the measurement [lanes, rows], by name
    status       of each lane: "ok", or why it has no numbers
    notes        what the result tells of the prediction, such as how modes were paired
    """

    value: Tensor
    by_design: Tensor | None
    by_unknown: Mapping[str, Tensor] = field(default_factory=dict)
    status: list[str] = field(default_factory=list)
    notes: tuple[str, ...] = ()


class Measurement:
    """Measured numbers and the response of a model to them."""

    def check(self, system: System) -> None:
        """Raise InputError if the system lacks what was measured."""
        raise NotImplementedError(type(self).__name__)

    @property
    def blocks(self) -> list[Block]:
        """What was measured, in the order of the rows of a prediction."""
        raise NotImplementedError(type(self).__name__)

    @property
    def unknowns(self) -> dict[str, nn.Parameter]:
        """Unknowns of the measurement itself by name, such as "tip.delay"."""
        return {}

    @property
    def sets(self) -> list[str]:
        """Parameters of the system that it sets itself, such as loads: none of them is an unknown or a setting."""
        return []

    def until(self, limits: Limits) -> float:
        """How long a motion must last for it [s], for all values of its unknowns within limits; 0: it needs no motion."""
        return 0.0

    def within(self, limits: Limits, run: Run) -> Self:
        """The measurement without numbers for which the model has none, whatever its unknowns within limits.

        run  of the model where the search begins, without gradients
        """
        return self

    def predict(self, run: Run, unknowns: Mapping[str, Tensor]) -> Prediction:
        """The numbers of the model in a run; unknowns: values of its own [lanes], by name."""
        raise NotImplementedError(type(self).__name__)


def number_of(x: float | Tensor, name: str, unknowns: Mapping[str, Tensor]) -> Tensor:
    """A number of a measurement [lanes] or [1]: the value of the unknown of this name, or the constant."""
    return unknowns[name] if name in unknowns else torch.tensor([float(x)], dtype=torch.float64)


def unit_of_title(title: str) -> str:
    """The unit of a title, `angle of hinge [rad]`; "" if it has none."""
    return title.rpartition("[")[2].removesuffix("]") if title.endswith("]") else ""
