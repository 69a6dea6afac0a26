"""Control histories: parameters are values at equidistant times, with linear or constant values between them; a module for a
Controller whose input is the time."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import parameter, positive

_KINDS = ("linear", "hold")
_ROUNDING = 1e-9  # share of an interval by which rounding may move a time


class ControlHistory(nn.Module):
    """Open-loop control u(t): the module of a Controller whose only input is mbd.signals.Time().

    values     [times, actuators] [N] or [N m]; a parameter
    duration   [s]
    kind       "linear": between values at `times` equal times 0 ... duration; "hold": each value holds for duration / times

    Before the first time the first value acts, and after the last time the last value. At the instant where a held value
    changes, the mean of the old and the new value acts. So steps that end there have the exact impulse
    (integrate/held_times.py).

    >>> push = mbd.ControlHistory([[0.0], [2.0], [0.0]], duration=1.0)
    >>> push(torch.tensor([[0.25]], dtype=torch.float64)).tolist()  # [N]
    [[1.0]]
    """

    def __init__(self, values: Any, duration: float, kind: str = "linear"):
        super().__init__()
        if kind not in _KINDS:
            raise InputError("kind", kind, ", ".join(map(repr, _KINDS)), noun="kind of a ControlHistory")
        values = parameter("values", values)
        least = 2 if kind == "linear" else 1
        if values.dim() != 2 or values.shape[0] < least or not values.shape[1]:
            raise InputError(
                "values",
                values,
                f"must have shape [times, actuators], {least} times or more",
                noun="values of a ControlHistory",
                state=f"have shape {list(values.shape)}",
            )
        if not bool(torch.isfinite(values).all()):
            raise InputError(
                "values", values, "finite numbers", noun="values of a ControlHistory", state="are not all finite"
            )
        self.values, self.kind = values, kind
        self.duration = positive("duration", duration, "s")

    @property
    def jumps(self) -> list[float]:
        """Times [s] at which one held value changes to the next; empty for kind "linear"."""
        count = len(self.values) if self.kind == "hold" else 1
        return [k * self.duration / count for k in range(1, count)]

    def forward(self, t: Tensor) -> Tensor:
        """u [lanes, actuators] at times t [lanes, 1]."""
        count = len(self.values) - (self.kind == "linear")
        place = (t[:, 0] * (count / self.duration)).clamp(0.0, float(count))
        before, after = ((place.detach() + x).floor().long().clamp(0, count - 1) for x in (-_ROUNDING, _ROUNDING))
        if self.kind == "hold":
            return 0.5 * (self.values[before] + self.values[after])
        k = after
        share = (place - k)[:, None]
        return self.values[k] * (1.0 - share) + self.values[k + 1] * share
