"""Measured histories: channels over time, sampled at other times than the steps of the motion.

    r_k = (gain y(t_k - delay) + offset - measured_k) / deviation

y is the curve through the states of the motion: a Hermite polynomial of fifth degree with exact rates where the response has
them, else of third degree (design/spline.py). Derivatives with respect to parameters of the system are those of the steps,
pushed forward through this curve (design/differentiate.py).

Checked in tests/extensions/identification/test_time_series.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from torchmbd.design.curve import curve_of
from torchmbd.design.spline import Spline
from torchmbd.errors import InputError, within
from torchmbd.extensions.identification.channel import SENSOR, Channel, channels_of
from torchmbd.extensions.identification.measurement import Block, Limits, Measurement, Prediction, number_of
from torchmbd.extensions.identification.run import Run
from torchmbd.extensions.identification.table import Table
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System


@dataclass(frozen=True, eq=False)
class Samples:
    """Numbers of a channel [k] at times [s]; deviation [k] or None; `outside`: how many the motion cannot have."""

    t: np.ndarray
    y: np.ndarray
    deviation: np.ndarray | None
    outside: int = 0


class TimeSeries(Measurement):
    """Channels measured over time.

    data      a CSV file, a DataFrame or a mapping of arrays: a column of times, one for each channel; nan is a gap
    channels  name -> mbd.identification.Channel(...), or a history whose name is that of its column
    time      name of the column of times, in ascending order [s], from the start of the motion; a unit may be in its heading

    Raises InputError for columns that do not exist, with the nearest name; for a field that is not a number, with its line;
    for times that do not increase; for a channel of gaps alone.

    >>> t = np.linspace(0.0, 1.0, 50)
    >>> series = mbd.identification.TimeSeries({"t": t, "x": np.sin(t)}, {"x": mbd.Position("bob", "x")})
    >>> [block.title for block in series.blocks]
    ['x position of bob [m]']
    """

    def __init__(self, data: Any, channels: Mapping[str, Any], time: str = "t"):
        self.channels = channels_of(channels)
        columns = {name: channel.column or name for name, channel in self.channels.items()}
        table = Table.of(data, list(dict.fromkeys([time, *columns.values()])))
        t = _times(table, time)
        self.samples = {name: _samples(table, t, name, columns[name], x) for name, x in self.channels.items()}

    def check(self, system: System) -> None:
        for name, channel in self.channels.items():
            try:
                channel.response.check(system)
            except InputError as error:
                raise within(f"channel {name!r}", error, "channels", name) from None

    @property
    def blocks(self) -> list[Block]:
        result = []
        for name, samples in self.samples.items():
            note = f"{samples.outside} samples are left out: with some delay within its bounds they are not within the motion"
            note = note if samples.outside else ""
            title = self.channels[name].title
            result.append(Block(name, samples.t, samples.y, samples.deviation, title, note=note))
        return result

    @property
    def unknowns(self) -> dict[str, nn.Parameter]:
        return {f"{name}.{key}": x for name, channel in self.channels.items() for key, x in channel.unknowns.items()}

    def until(self, limits: Limits) -> float:
        return max(s.t[-1] - self._delays(name, limits)[0] for name, s in self.samples.items())

    def within(self, limits: Limits, run: Run) -> Self:
        duration = run.duration
        result = object.__new__(type(self))
        result.channels, result.samples = self.channels, {}
        rounding = 1e-9 * duration
        for name, s in self.samples.items():
            least, most = self._delays(name, limits)
            inside = (s.t - most >= -rounding) & (s.t - least <= duration + rounding)
            if inside.all():
                result.samples[name] = s
                continue
            if not inside.any():
                state = f"has no sample within the motion, 0 to {duration:g} s, for a delay of {least:g} to {most:g} s"
                hint = "other bounds of its delay, or another duration"
                raise InputError(("channels", name), hint=hint, noun=f"channel {name!r}", state=state)
            deviation = None if s.deviation is None else s.deviation[inside]
            result.samples[name] = Samples(s.t[inside], s.y[inside], deviation, int((~inside).sum()))
        return result

    def _delays(self, name: str, limits: Limits) -> tuple[float, float]:
        """The smallest and the largest delay of a channel [s]."""
        delay, key = self.channels[name].delay, f"{name}.delay"
        if not isinstance(delay, nn.Parameter):
            return float(delay), float(delay)
        least, most = limits[key]
        if not np.isfinite([least, most]).all():
            state, allowed = f"are ({least:g}, {most:g}) s", "finite"
            raise InputError(("bounds", key), (least, most), allowed, noun=f"bounds of {key}", state=state)
        return least, most

    def predict(self, run: Run, unknowns: Mapping[str, Tensor]) -> Prediction:
        numbers = {
            (name, key): number_of(getattr(channel, key), f"{name}.{key}", unknowns)[:, None].expand(run.lanes, 1)
            for name, channel in self.channels.items()
            for key in SENSOR
        }
        late = [name for name in self.channels if f"{name}.delay" in unknowns and run.gradients]

        def rows(motion: Trajectory) -> Tensor:
            """Values of all channels, then rates of those with unknown delays [lanes, rows]."""
            curves = {name: self._curve(motion, name, numbers[name, "delay"]) for name in self.channels}
            parts = [curve.at(t) for curve, t in curves.values()]
            parts += [curves[name][0].at(curves[name][1], 1) for name in late]
            most = max(len(x) for x in parts)  # delays of several lanes of a motion that has one
            return motion.sound(torch.cat([x.expand(most, -1) for x in parts], 1))

        y, sizes = run.of_motion(rows), [len(self.samples[name].t) for name in self.channels]
        count = sum(sizes)
        values = dict(zip(self.channels, y.value[:, :count].split(sizes, 1), strict=True))
        rates = dict(zip(late, y.value[:, count:].split([len(self.samples[name].t) for name in late], 1), strict=True))
        gains = torch.cat([numbers[name, "gain"].expand(-1, len(self.samples[name].t)) for name in self.channels], 1)
        shown = torch.cat([numbers[name, "gain"] * x + numbers[name, "offset"] for name, x in values.items()], 1)
        by_design = None if y.gradient is None else gains[..., None] * y.gradient[:, :count]
        by_unknown = {key: torch.zeros(run.lanes, count, dtype=torch.float64) for key in unknowns}
        for name, first in zip(self.channels, np.cumsum([0, *sizes]).tolist(), strict=False):
            derivatives = {"gain": values[name], "offset": torch.ones_like(values[name])}
            derivatives |= {"delay": -numbers[name, "gain"] * rates[name]} if name in rates else {}
            for key in (key for key in derivatives if f"{name}.{key}" in by_unknown):
                by_unknown[f"{name}.{key}"][:, first : first + values[name].shape[1]] = derivatives[key]
        return Prediction(shown, by_design, by_unknown, run.status)

    def _curve(self, motion: Trajectory, name: str, delay: Tensor) -> tuple[Spline, Tensor]:
        """The curve of a channel, and the times of its samples on it [k] or [lanes, k]; delay [1, 1] or [lanes, 1]."""
        response = self.channels[name].response
        curve = curve_of(motion, lambda part, _: (response.values(part), response.rates(part)))
        t = (torch.from_numpy(self.samples[name].t) - delay).clamp(min=0.0, max=curve.span[1])  # of rounding
        return curve, t[0] if len(t) == 1 else t


def _times(table: Table, time: str) -> np.ndarray:
    """The column of times in seconds; InputError if they do not increase, with the line."""
    factor, si = table.factor(time, None)
    if si not in (None, "s"):
        raise InputError("time", time, "s or ms", noun=f"unit of the times {time!r}", state=f"is of [{si}]")
    t = table.columns[time] if factor == 1.0 else factor * table.columns[time]
    if not len(t):
        raise InputError(
            "data", allowed="must have at least one time", state=f"has no rows{f': {table.file}' if table.file else ''}"
        )
    wrong = np.flatnonzero(~np.isfinite(t))
    if len(wrong):
        noun, value = f"{table.row(int(wrong[0]))}: time {time!r}", float(t[wrong[0]])
        raise InputError("time", value, "a finite number", noun=noun, shown=f"{value:g}")
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if len(back):
        k = int(back[0]) + 1
        state, allowed = f"follows {t[k - 1]:.9g} s", "later than this"
        raise InputError("time", float(t[k]), allowed, noun=f"{table.row(k)}: time {t[k]:.9g} s", state=state)
    if t[0] < 0.0:
        noun, allowed = f"{table.row(0)}: time", "at or after 0, the start of the motion"
        raise InputError("time", float(t[0]), allowed, noun=noun, shown=f"{t[0]:g} s")
    return t


def _samples(table: Table, t: np.ndarray, name: str, column: str, channel: Channel) -> Samples:
    """Numbers of a channel without its gaps."""
    path, noun = ("channels", name), f"channel {name!r}"
    y = channel.si(noun, table, column)
    deviation = channel.deviation
    if isinstance(deviation, np.ndarray) and len(deviation) != len(y):
        state, allowed = f"has {len(deviation)} values", f"must have {len(y)}, or one for all"
        raise InputError((*path, "deviation"), deviation, allowed, noun=f"deviation of {noun}", state=state)
    present = np.isfinite(y)
    infinite = np.flatnonzero(np.isinf(y))
    if len(infinite):
        k = int(infinite[0])
        allowed = "a finite number, or nan for a gap"
        raise InputError(path, float(y[k]), allowed, noun=f"{table.row(k)}: {noun}", shown=f"{y[k]:g}")
    if not present.any():
        state, allowed = (
            f"has only gaps, because every row of column {column!r} is nan",
            "must have at least one number",
        )
        raise InputError(path, noun=noun, allowed=allowed, state=state)
    spread = None if deviation is None else np.broadcast_to(np.asarray(deviation, dtype=float), y.shape)
    if present.all():
        return Samples(t, y, spread)
    return Samples(t[present], y[present], None if spread is None else spread[present])
