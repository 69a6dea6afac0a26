"""A measurement without a motion: channels that are functions of unknowns of their own, for tests of many fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from torchmbd.extensions.identification.measurement import Block, Measurement, Prediction

Curve = Callable[[Mapping[str, torch.Tensor], torch.Tensor], torch.Tensor]  # unknowns by name, x -> y [rows]


class ClosedForm(Measurement):
    """Channels by name: (x, measured, deviation or None, curve); numbers: starts of the unknowns by name."""

    def __init__(
        self, channels: Mapping[str, tuple[Any, Any, Any, Curve]], numbers: Mapping[str, float], unit: str = ""
    ):
        self.channels, self.unit = channels, unit
        self.variables = {name: mbd.variable(x) for name, x in numbers.items()}

    def check(self, system: mbd.System) -> None:
        pass

    @cached_property
    def blocks(self) -> list[Block]:
        return [
            Block(
                name, np.asarray(x), np.asarray(y), None if s is None else np.full(len(y), s), f"{name}{self.unit}", "x"
            )
            for name, (x, y, s, _) in self.channels.items()
        ]

    @property
    def unknowns(self):
        return self.variables

    def predict(self, run, unknowns) -> Prediction:
        names = list(unknowns)
        X = torch.stack([unknowns[name] for name in names], 1)

        def rows(b: torch.Tensor) -> torch.Tensor:
            parameters = dict(zip(names, b, strict=True))
            return torch.cat([curve(parameters, torch.as_tensor(x)) for x, _, _, curve in self.channels.values()])

        slopes = torch.stack([torch.autograd.functional.jacobian(rows, x) for x in X])
        values = torch.stack([rows(x) for x in X])
        by_unknown = {name: slopes[..., k] for k, name in enumerate(names)}
        by_design = torch.zeros(*values.shape, 0, dtype=torch.float64) if run.gradients else None
        return Prediction(values, by_design, by_unknown, ["ok"] * len(X))


def fit(
    channels: Mapping[str, tuple[Any, Any, Any, Curve]], numbers: Mapping[str, float], unit: str = "", **arguments: Any
):
    """Fit the unknowns of channels; unit: of all channels, in brackets."""
    experiment = mbd.identification.Experiment(
        mbd.examples.pendulum(), ClosedForm(channels, numbers, unit), duration=1.0
    )
    return mbd.identification.identify(experiment, **arguments)
