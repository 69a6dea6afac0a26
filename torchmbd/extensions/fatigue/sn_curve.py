"""Fatigue strength: cycles to failure of a stress that swings with an amplitude about a mean.

    log N(a0)               straight lines between measured points in log a, log N (S-N curve), continued beyond both ends
    a0 = a A(0) / A(mean)   amplitude at mean zero that has the same life
    A(mean) = (T + C - |2 mean - T + C|) / 2         constant-life diagram: a triangle between the strengths -C and T

T, C     static strengths in tension and compression [Pa]        a, mean     amplitude and mean of a cycle [Pa]

For C = T this is Goodman's line, for tension and compression alike. A mean within a thousandth of a strength counts as that
thousandth: the life is then shorter than any that is allowed, and has a derivative.
Source: Goodman, Mechanics Applied to Engineering (1899); the diagram for laminates: Germanischer Lloyd, Guideline for the
Certification of Wind Turbines (2010), section 5.5.3.
Checked in tests/extensions/fatigue/test_fatigue.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import scalar
from torchmbd.math.gradients import refuse_gradients

_LEAST = 1e-3  # least allowable amplitude as a share of the smaller strength


@dataclass(frozen=True)
class SNCurve:
    """An S-N curve with its constant-life diagram.

    points        at least two pairs (cycles, amplitude [Pa]) at mean zero, with increasing cycles and decreasing amplitudes
    tension       static tensile strength [Pa]; None: the mean stress has no influence
    compression   static compressive strength [Pa]; None: equal to `tension`
    Raises InputError that names a point out of order.

    >>> curve = mbd.fatigue.SNCurve([(1e3, 400e6), (1e6, 200e6)], tension=1000e6)
    >>> curve.cycles(torch.tensor([400e6, 200e6]), torch.tensor([0.0, 0.0]))
    tensor([1.0000e+03, 1.0000e+06])
    >>> bool(curve.cycles(torch.tensor(200e6), torch.tensor(500e6)) < 1.001e3)  # Goodman: 400e6 at mean zero
    True
    """

    points: Sequence[tuple[float, float]]
    tension: float | None = None
    compression: float | None = None

    def __post_init__(self) -> None:
        refuse_gradients("points", self.points, "pairs (cycles, amplitude [Pa])")
        try:
            points = tuple((float(n), float(a)) for n, a in self.points)
        except (TypeError, ValueError):
            raise InputError("points", self.points, "pairs (cycles, amplitude [Pa])") from None
        object.__setattr__(self, "points", points)
        if len(points) < 2:
            raise InputError("points", self.points, "at least two pairs (cycles, amplitude [Pa])")
        for k, (n, a) in enumerate(points):
            if not (0.0 < n < math.inf and 0.0 < a < math.inf):
                raise InputError(
                    ("points", k),
                    (n, a),
                    "positive cycles and a positive amplitude [Pa]",
                    noun=f"points[{k}]",
                    shown=f"{(n, a)}",
                )
            if k and not (n > points[k - 1][0] and a < points[k - 1][1]):
                raise InputError(
                    ("points", k),
                    (n, a),
                    "must have more cycles, and a smaller amplitude",
                    noun=f"points[{k}]",
                    shown=f"{(n, a)} after {points[k - 1]}",
                )
        for name in ("tension", "compression"):
            x = getattr(self, name)
            if x is not None and scalar(name, x, "a positive number [Pa], or None") <= 0.0:
                raise InputError(name, x, "a positive number [Pa], or None")
        if self.tension is None and self.compression is not None:
            raise InputError(
                "compression",
                self.compression,
                "given with tension, or left out",
                state=f"is {self.compression!r} without tension",
            )

    def cycles(self, amplitude: Tensor, mean: Tensor) -> Tensor:
        """Cycles to failure [...] of amplitudes and means [...] [Pa]; inf where the amplitude is zero."""
        x = torch.tensor([math.log(a) for _, a in reversed(self.points)], dtype=torch.float64)
        y = torch.tensor([math.log(n) for n, _ in reversed(self.points)], dtype=torch.float64)
        if self.tension is not None:
            tension = amplitude.new_tensor(self.tension)
            compression = tension if self.compression is None else amplitude.new_tensor(self.compression)
            amplitude = amplitude * mean_factor(mean, tension, compression)
        x, y = x.to(amplitude), y.to(amplitude)
        rests = amplitude <= 0.0
        log = torch.log(torch.where(rests, 1.0, amplitude))
        place = torch.searchsorted(x, log.detach().contiguous()).clamp(1, len(x) - 1)
        slope = (y[place] - y[place - 1]) / (x[place] - x[place - 1])
        return torch.where(rests, math.inf, torch.exp(y[place - 1] + slope * (log - x[place - 1])))


def mean_factor(mean: Tensor, tension: Tensor, compression: Tensor) -> Tensor:
    """Return A(0) / A(mean), the factor of the amplitude by the mean of a cycle [-]."""
    allowable = 0.5 * (tension + compression - (2.0 * mean - tension + compression).abs())
    most = torch.minimum(tension, compression)
    return most / torch.maximum(allowable, _LEAST * most)


def power_law_damage(amplitude: Tensor, mean: Tensor, tension: Tensor, compression: Tensor, exponent: Any) -> Tensor:
    """Damage of one cycle (amplitude / A(mean))^exponent: a life of one cycle at the static strength."""
    most = torch.minimum(tension, compression)
    return (amplitude * mean_factor(mean, tension, compression) / most) ** exponent
