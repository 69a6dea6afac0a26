"""Laws of drives: a prescribed angle [rad] or travel [m] as a function of time [s].

    ConstantSpeed   x = speed t
    SmoothStep      x = size (10 s^3 - 15 s^4 + 6 s^5),  s = (t - start) / duration within 0..1: from rest to rest
    Sine            x = amplitude sin(2 pi frequency t)

A law of one's own is a torch function of one time [] that is differentiable twice. A law that states its `slopes`
takes many times at once. `Finite` is the law of a joint: one that gives nan or inf is an error with the joint's name.
Source: the quintic of zero velocity and acceleration at both ends, e.g. Craig, Introduction to Robotics, eq. (7.18).
Checked in tests/joints/test_laws.py: slopes against automatic differentiation.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.joints.primitive import Law, slopes, slopes_at, values_at

Slopes = tuple[Tensor, Tensor, Tensor]


class ConstantSpeed:
    """x(t) = speed * t; speed in [rad/s] or [m/s]."""

    def __init__(self, speed: float | Tensor):
        self.speed = finite("speed", speed)

    def __call__(self, t: Tensor) -> Tensor:
        return self.speed * t

    def slopes(self, t: Tensor) -> Slopes:
        """Value, speed and acceleration at the times t."""
        return self.speed * t, torch.full_like(t, self.speed), torch.zeros_like(t)


class SmoothStep:
    """From 0 to `size` [rad] or [m] between `start` and `start + duration` [s], at rest before and after.

    Velocity and acceleration are continuous; the largest velocity is 1.875 size / duration.
    """

    def __init__(self, size: float | Tensor, duration: float, start: float = 0.0):
        self.size, self.start = finite("size", size), finite("start", start)
        self.duration = finite("duration", duration)
        if not self.duration > 0:
            raise InputError(f"duration is {duration!r} s; allowed: a positive number")

    def __call__(self, t: Tensor) -> Tensor:
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


class Sine:
    """x(t) = amplitude sin(2 pi frequency t); amplitude in [rad] or [m], frequency in [Hz]."""

    def __init__(self, amplitude: float | Tensor, frequency: float):
        self.amplitude = finite("amplitude", amplitude)
        self.rate = 2.0 * math.pi * finite("frequency", frequency)

    def __call__(self, t: Tensor) -> Tensor:
        return self.amplitude * torch.sin(self.rate * t)

    def slopes(self, t: Tensor) -> Slopes:
        """Value, velocity and acceleration at the times t."""
        x = self(t)
        return x, self.amplitude * self.rate * torch.cos(self.rate * t), -self.rate * self.rate * x


class Finite:
    """The law of the joint `name`: at one time or many, with its slopes, and never nan or inf."""

    def __init__(self, name: str, law: Law):
        self.name, self.law = name, law

    def __call__(self, t: Tensor) -> Tensor:
        return self._finite(values_at(self.law, t) if t.dim() else self.law(t), t)

    def slopes(self, t: Tensor) -> Slopes:
        """Value, velocity and acceleration at the times t."""
        x, velocity, acceleration = slopes_at(self.law, t) if t.dim() else slopes(self.law, t)
        return self._finite(x, t), self._finite(velocity, t), self._finite(acceleration, t)

    def _finite(self, x: Tensor, t: Tensor) -> Tensor:
        good = torch.isfinite(x)
        if not bool(good.all()):
            first = t[~good][0] if t.dim() else t
            raise InputError(
                f"the law of {self.name!r} or a slope of it is not finite at t = {float(first):.6g} s; "
                "allowed: a finite number at every time"
            )
        return x


def finite(name: str, x: Any) -> float:
    """A finite number, of Python or a tensor without a gradient (mbd.deg); InputError names the argument."""
    if isinstance(x, Tensor) and x.dim() == 0 and not x.requires_grad:
        x = float(x)
    if isinstance(x, bool) or not isinstance(x, (int, float)) or not math.isfinite(x):
        raise InputError(f"{name} is {x!r}; allowed: a finite number")
    return float(x)
