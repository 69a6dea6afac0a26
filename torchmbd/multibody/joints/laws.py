"""Laws of drives: a prescribed angle [rad] or travel [m] as a function of time [s].

    ConstantSpeed   x = speed t
    SmoothStep      x = size (10 s^3 - 15 s^4 + 6 s^5),  s = (t - start) / duration within 0..1: from rest to rest
    Sine            x = amplitude sin(2 pi frequency t)

A law of a user is a torch function of one time [] that is differentiable twice. A law that states its `slopes` takes many times
at once. `FiniteLaw` is the law of a joint: nan or inf raise an error with the joint's name.
Each number may be a design variable, `Sine(mbd.variable(0.4), 1.5)`, as may the parameters of any torch module
(parametric_law.py).
Source: the quintic of zero velocity and acceleration at both ends, e.g. Craig, Introduction to Robotics, eq. (7.18).
Checked in tests/multibody/joints/test_laws.py: slopes against automatic differentiation.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, Path
from torchmbd.math.variable import is_variable
from torchmbd.multibody.joints.primitive import Law, slopes, slopes_at, values_at

Slopes = tuple[Tensor, Tensor, Tensor]


class ConstantSpeed(nn.Module):
    """x(t) = speed * t; speed in [rad/s] or [m/s].

    >>> mbd.ConstantSpeed(3.0)(torch.tensor([0.0, 2.0], dtype=torch.float64)).tolist()
    [0.0, 6.0]
    """

    def __init__(self, speed: float | Tensor):
        super().__init__()
        self.speed = finite("speed", speed)

    def forward(self, t: Tensor) -> Tensor:
        return self.speed * t

    def slopes(self, t: Tensor) -> Slopes:
        """Value, speed and acceleration at the times t."""
        return self.speed * t, self.speed + torch.zeros_like(t), torch.zeros_like(t)


class SmoothStep(nn.Module):
    """From 0 to `size` [rad] or [m] between `start` and `start + duration` [s], at rest before and after.

    Velocity and acceleration are continuous; the largest velocity is 1.875 size / duration.

    >>> law = mbd.SmoothStep(size=1.0, duration=0.4, start=0.1)
    >>> law(torch.tensor([0.1, 0.3, 0.9], dtype=torch.float64)).round(decimals=9).tolist()
    [0.0, 0.5, 1.0]
    """

    def __init__(self, size: float | Tensor, duration: float | Tensor, start: float | Tensor = 0.0):
        super().__init__()
        self.size, self.start = finite("size", size), finite("start", start)
        self.duration = finite("duration", duration)
        if not self.duration > 0:
            raise InputError("duration", duration, "a positive number", shown=f"{duration!r} s")

    def forward(self, t: Tensor) -> Tensor:
        s = self._share(t)
        return self.size * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)

    def slopes(self, t: Tensor) -> Slopes:
        """Value, velocity and acceleration at the times t."""
        s, h = self._share(t), self.duration
        velocity = 30.0 * (s * (1.0 - s)) ** 2
        acceleration = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
        return self(t), self.size / h * velocity, self.size / (h * h) * acceleration

    def _share(self, t: Tensor) -> Tensor:
        return ((t - self.start) / self.duration).clamp(0.0, 1.0)


class Sine(nn.Module):
    """x(t) = amplitude sin(2 pi frequency t); amplitude in [rad] or [m], frequency in [Hz].

    >>> law = mbd.Sine(amplitude=0.1, frequency=2.0)
    >>> law(torch.tensor(0.125, dtype=torch.float64)).item()  # a quarter of the period
    0.1
    """

    def __init__(self, amplitude: float | Tensor, frequency: float | Tensor):
        super().__init__()
        self.amplitude, self.frequency = finite("amplitude", amplitude), finite("frequency", frequency)

    def forward(self, t: Tensor) -> Tensor:
        return self.amplitude * torch.sin(self._rate * t)

    def slopes(self, t: Tensor) -> Slopes:
        """Value, velocity and acceleration at the times t."""
        x, rate = self(t), self._rate
        return x, self.amplitude * rate * torch.cos(rate * t), -rate * rate * x

    @property
    def _rate(self) -> Any:
        return 2.0 * math.pi * self.frequency


class FiniteLaw:
    """A law of the joint `name` at one time or many, with its slopes; InputError if it is nan or inf."""

    def __init__(self, name: str, law: Law):
        self.name, self.law = name, law

    def __call__(self, t: Tensor) -> Tensor:
        x = values_at(self.law, t) if t.dim() else self.law(t)
        self._require_finite(t, x)
        return x

    def slopes(self, t: Tensor) -> Slopes:
        """Value, velocity and acceleration at the times t."""
        x, velocity, acceleration = slopes_at(self.law, t) if t.dim() else slopes(self.law, t)
        self._require_finite(t, x, velocity, acceleration)
        return x, velocity, acceleration

    def _require_finite(self, t: Tensor, *numbers: Tensor) -> None:
        good = torch.isfinite(torch.stack(numbers)).all(0)
        if not bool(good.all()):
            first = t[~good][0] if t.dim() else t
            raise InputError(
                (self.name, "law"),
                allowed="a finite number at every time",
                state=f"is not finite at t = {float(first):.6g} s",
                noun=f"the law of {self.name!r} or a slope of it",
            )


def finite(name: str | Path, x: Any) -> Any:
    """Return the argument x as a finite float, or unchanged if it is a design variable with one entry; InputError names it.

    A tensor without a gradient (mbd.deg) is a number.
    """
    if is_variable(x):
        return x
    if isinstance(x, Tensor) and x.dim() == 0 and not x.requires_grad:
        x = float(x)
    if isinstance(x, bool) or not isinstance(x, (int, float)) or not math.isfinite(x):
        raise InputError(name, x, "a finite number, or mbd.variable(...) of one")
    return float(x)
