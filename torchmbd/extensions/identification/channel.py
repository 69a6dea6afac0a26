"""A channel of a measurement: what a sensor shows, as a function of what the model does.

    shown(t) = gain y(t - delay) + offset        y: a history of the model, such as mbd.Position("tip", "x")

Delay, gain and offset are numbers, or unknowns: mbd.variable(...). The derivative with respect to the delay is that of the
curve through the states of the motion (design/spline.py).
Checked in tests/extensions/identification/test_time_series.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor, nn

from torchmbd.design.response import History
from torchmbd.design.words import heading, unit
from torchmbd.errors import InputError, Path
from torchmbd.extensions.identification.table import Table, checked_unit
from torchmbd.math.checked_numbers import positive, scalar
from torchmbd.math.gradients import is_variable

SENSOR = ("delay", "gain", "offset")


@dataclass(frozen=True, eq=False)
class Channel:
    """One column of measured numbers, and the response of the model that it measures.

    response   a history of the model, such as mbd.Position("tip", "x"), in its SI unit
    column     name of the column; None: the name of the channel
    unit       unit of the column, such as "mm"; None: the unit in brackets in its heading, or the SI unit
    deviation  standard deviation of the noise, in the SI unit of the response: a number, or one for each row;
               None: estimated from the residuals
    delay      of the sensor [s];  gain [-];  offset, in the SI unit of the response: numbers, or mbd.variable(...) of
               one, which makes it an unknown "<channel>.delay"

    >>> channel = mbd.identification.Channel(mbd.Position("tip", "x"), unit="mm", deviation=1e-4, delay=mbd.variable(0.0))
    >>> list(channel.unknowns)
    ['delay']
    """

    response: History
    column: str | None = None
    unit: str | None = None
    deviation: Any = None
    delay: float | Tensor = 0.0
    gain: float | Tensor = 1.0
    offset: float | Tensor = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.response, History):
            raise InputError(
                "response", self.response, "a history, such as mbd.Position('tip', 'x')", noun="response of Channel"
            )
        if not self.response.smooth:
            raise InputError(
                "response",
                allowed="the continuous angle",
                noun="response of Channel",
                state="is an angle with wrapped=True, which jumps",
            )
        if self.column is not None and not isinstance(self.column, str):
            raise InputError("column", self.column, "the name of a column, or None", noun="column of Channel")
        if self.unit is not None:
            object.__setattr__(self, "unit", checked_unit("unit of Channel", self.unit))
        for name in SENSOR:
            x = getattr(self, name)
            if not is_variable(x):
                scalar(name, x, "a finite number, or mbd.variable(...) of one")
        if self.deviation is not None:
            object.__setattr__(self, "deviation", checked_deviation("deviation", self.deviation))

    @property
    def unknowns(self) -> dict[str, nn.Parameter]:
        """Delay, gain and offset that are variables, by name."""
        return {name: x for name in SENSOR if isinstance(x := getattr(self, name), nn.Parameter)}

    @property
    def title(self) -> str:
        """The response and its unit in words."""
        return heading(self.response)

    def si(self, what: str, table: Table, column: str) -> np.ndarray:
        """The numbers of a column in the SI unit of the response; InputError for a unit that the response cannot have."""
        factor, si = table.factor(column, self.unit)
        expected = unit(self.response)
        if si is not None and expected is not None and si != expected.replace("²", "2"):
            allowed = f"one of [{expected or '-'}], the unit of {self.response!r}"
            noun, shown = f"unit of {what}", f"of [{si or '-'}]"
            raise InputError(("columns", column), si, allowed, noun=noun, shown=shown)
        numbers = table.columns[column]
        return numbers if factor == 1.0 else factor * numbers


def channels_of(channels: Any) -> dict[str, Channel]:
    """Channels by name, of channels or of histories; InputError for anything else."""
    if not isinstance(channels, Mapping) or not channels:
        raise InputError(
            "channels",
            channels,
            "a mapping name -> mbd.identification.Channel(...), or name -> history, with at least one name",
        )
    result = {}
    for name, x in channels.items():
        if not isinstance(name, str) or not isinstance(x, (Channel, History)):
            raise InputError(
                ("channels", name), x, "mbd.identification.Channel(...), or a history", noun=f"channel {name!r}"
            )
        result[name] = x if isinstance(x, Channel) else Channel(x)
    return result


def checked_deviation(what: str | Path, deviation: Any) -> float | np.ndarray:
    """A positive standard deviation, or one for each row; InputError for other values."""
    if np.ndim(deviation) == 0:
        return positive(what, deviation, "")
    try:
        values = np.asarray(deviation, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(1)
    if values.ndim != 1 or not (values > 0.0).all() or not np.isfinite(values).all():
        raise InputError(str(what), deviation, "a positive number, or a positive number for each row")
    return values
