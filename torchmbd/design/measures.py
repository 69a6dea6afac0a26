"""Measures: one number of a whole motion, from a history or from the design itself.

    Integral   int y dt            of the curve through all states of the motion (spline.py)          eq. (21)
    Mean       1/T int y dt
    RMS        (1/T int y^2 dt)^1/2
    Max, Min   the peak, located between the output times (spline.py)                         eq. (18)
    AtTime     y(t)                Final: y at the end
    SmoothMax  c/rho ln sum exp(rho y_k / c)      c: scale in the unit of y, rho: sharpness
               at least the largest sample, at most c ln(samples)/rho above it; smooth where another peak becomes the largest
    Frequency  of a mode of a body fixed at its reference nodes, or on other supports [Hz]
    MeanFrequency  power mean of several, which is smooth where they cross [Hz]
    Mass       of a body, or of all bodies [kg]

`window` (t0, t1) [s] selects a part of the motion; values at its ends are interpolated.
Source of SmoothMax: Kreisselmeier and Steinhauser, IFAC Symp. Computer Aided Design of Control Systems (1979) 113-117.
Checked in tests/contracts/test_responses.py, tests/design/test_measures.py, tests/design/test_frequencies.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchmbd.design.curve import curve_of
from torchmbd.design.histories import flexible_body
from torchmbd.design.response import History, Measure, check_scale
from torchmbd.design.spline import Spline, Window, checked_window
from torchmbd.design.supported_frequencies import check_supports, supported_frequencies
from torchmbd.errors import InputError
from torchmbd.fem.reduction import eigenvalues
from torchmbd.fem.reduction.padding import with_stiff_padding
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole, scalar
from torchmbd.multibody.statics.supported_body import Supports
from torchmbd.multibody.system import System


@dataclass(frozen=True)
class OfHistory(Measure):
    """A measure of a history on a window of time.

    history  y(t) [lanes, times]
    window   (t0, t1) [s]; None: the whole motion
    """

    history: History
    window: Window = None

    def __post_init__(self) -> None:
        _require_history(self, self.history)
        if self.window is not None:
            object.__setattr__(self, "window", checked_window(self.window))

    def check(self, system: System) -> None:
        self.history.check(system)

    @property
    def until(self) -> float:
        return 0.0 if self.window is None else self.window[1]

    def value(self, motion: Trajectory) -> Tensor:
        return self.reduce(_curve(self.history, self.window, motion))

    def reduce(self, curve: Spline) -> Tensor:
        """The numbers [lanes] or [lanes, rows] of the history as a curve."""
        raise NotImplementedError(type(self).__name__)

    @property
    def natural_zero(self) -> bool:
        return self.history.natural_zero

    def change(self, motion: Trajectory) -> Tensor:
        change = self.range_of(_curve(self.history, self.window, motion)).detach()
        return change if self.rows == 1 else change[:, None].expand(-1, self.rows)

    def range_of(self, curve: Spline) -> Tensor:
        """The range [lanes] of the curve, in the unit of the measure."""
        return curve.y.amax(-1) - curve.y.amin(-1)


def _require_history(measure: Measure, history: object) -> None:
    name = type(measure).__name__
    if not isinstance(history, History):
        raise InputError("history", history, "a history, such as StrainEnergy('rod')", noun=f"history of {name}")
    if not history.smooth:
        raise InputError(
            ("history", "wrapped"),
            True,
            "False",
            state="is True, and a wrapped angle jumps between two times",
            noun=f"wrapped of the angle in {name}",
            hint="wrapped=False",
        )


def _curve(history: History, window: Window, motion: Trajectory) -> Spline:
    """A history of a motion as a curve; `motion.known` keeps it for other measures of the same evaluation."""
    if not isinstance(motion, Trajectory):
        raise InputError("motion", motion, "a motion, the result of mbd.simulate(...)")
    known = motion.known
    try:
        if known is not None and (history, window) in known:
            return known[history, window]
    except TypeError:  # not hashable: an axis given as a list
        known = None
    curve = curve_of(motion, lambda part, lanes: (history.values(part), history.rates(part)), window)
    if known is not None:
        known[history, window] = curve
    return curve


class Integral(OfHistory):
    """Integral of a history over time [lanes], in the unit of the history times s; eq. (21).

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> round(mbd.Integral(mbd.Velocity("bob", "x"))(motion).item(), 2)  # distance in x [m]
    0.32
    >>> window = mbd.Integral(mbd.Velocity("bob", "x"), window=(0.0, 0.1))
    >>> round(window(motion).item(), 3)
    0.098
    """

    def reduce(self, curve: Spline) -> Tensor:
        return curve.integral()

    def range_of(self, curve: Spline) -> Tensor:
        return super().range_of(curve) * curve.duration


class Mean(OfHistory):
    """Mean of a history over time [lanes], in the unit of the history.

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> round(mbd.Mean(mbd.Velocity("bob", "x"))(motion).item(), 2)  # [m/s]
    0.63
    """

    def reduce(self, curve: Spline) -> Tensor:
        return curve.mean()


class RMS(OfHistory):
    """Root of the mean square of a history over time [lanes], in the unit of the history.

    It has no gradient where the history is zero at all times.

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> bending = mbd.Displacement("arm", "z", node="right")
    >>> round(1e3 * mbd.RMS(bending)(motion).item(), 1)  # [mm]
    1.2
    """

    def reduce(self, curve: Spline) -> Tensor:
        return torch.sqrt(curve.mean(power=2))


PEAK_NOTE = (
    "the error assumes that the same peak stays the largest; "
    "if another peak becomes the largest in the finer motion, the error is the difference of the two motions"
)


class Max(OfHistory):
    """Largest value of a history [lanes], in its unit; eq. (18). A spline finds the peak between the output times.

    If two peaks are exactly equal, the gradient is the mean of their two gradients. If they differ by rounding, the gradient
    is that of the larger one. `AtPeaks` keeps both peaks.

    >>> motion = mbd.simulate(mbd.examples.pendulum(speed=1.0), 1.0, steps=40)
    >>> top = mbd.Max(mbd.Position("bob", "y"))
    >>> round(top(motion).item(), 3)  # v^2 / (2 g) above -1 m
    -0.949
    """

    error_note: ClassVar[str] = PEAK_NOTE

    def reduce(self, curve: Spline) -> Tensor:
        return curve.maximum()


class Min(OfHistory):
    """Smallest value of a history [lanes], in its unit. A spline finds it between the output times.

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 1.0, steps=40)
    >>> round(mbd.Min(mbd.Position("bob", "y"))(motion).item(), 3)  # [m]
    -1.0
    """

    error_note: ClassVar[str] = PEAK_NOTE

    def reduce(self, curve: Spline) -> Tensor:
        return -curve.negative().maximum()


class Final(OfHistory):
    """Value of a history at the end of the motion, or at the end of its window [lanes], in its unit.

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> round(mbd.Final(mbd.Angle("bob", "z"))(motion).item(), 2)  # [rad]
    0.32
    """

    def reduce(self, curve: Spline) -> Tensor:
        return curve.y[..., -1]


@dataclass(frozen=True)
class AtTime(Measure):
    """Value of a history at one time [lanes], in its unit.

    history  y(t) [lanes, times]
    time     [s], from zero to the duration of the motion

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> round(mbd.AtTime(mbd.Position("bob", "x"), 0.1)(motion).item(), 3)  # [m]
    0.098
    """

    history: History
    time: float

    def __post_init__(self) -> None:
        _require_history(self, self.history)
        if scalar("time", self.time, "zero or positive [s]") < 0.0:
            raise InputError("time", self.time, "zero or positive [s]")

    def check(self, system: System) -> None:
        self.history.check(system)

    @property
    def until(self) -> float:
        return float(self.time)

    @property
    def natural_zero(self) -> bool:
        return self.history.natural_zero

    def change(self, motion: Trajectory) -> Tensor:
        y = _curve(self.history, None, motion).y.detach()
        return y.amax(-1) - y.amin(-1)

    def value(self, motion: Trajectory) -> Tensor:
        curve = _curve(self.history, None, motion)
        return curve.sampled(curve.t.new_tensor([float(self.time)]))[..., 0]


@dataclass(frozen=True)
class SmoothMax(OfHistory):
    """Smooth maximum of all samples [lanes], in the unit of the history.

    It lies between the largest sample and c ln(samples) / rho above it.

    sharpness  rho, positive: the larger, the nearer to the largest sample, and the less smooth [-]
    scale      c, positive: the size of the history, in its unit; it must be given
    Source: Kreisselmeier and Steinhauser (1979).

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 1.0, steps=40)
    >>> speed = mbd.Velocity("bob", "x")
    >>> bool(mbd.SmoothMax(speed, scale=1.0)(motion) > mbd.Max(speed)(motion))
    True
    >>> round(mbd.SmoothMax(speed, sharpness=1000.0, scale=1.0)(motion).item(), 2)  # [m/s]
    1.0
    """

    sharpness: float = 50.0
    scale: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if scalar("sharpness", self.sharpness, "a positive number") <= 0.0:
            raise InputError("sharpness", self.sharpness, "a positive number")
        check_scale(self.scale)

    def reduce(self, curve: Spline) -> Tensor:
        assert self.scale is not None  # since __post_init__
        rho, (y, new) = self.sharpness / self.scale, curve.samples()
        return torch.logsumexp(torch.where(new, rho * y, -torch.inf), -1) / rho


@dataclass(frozen=True)
class Frequency(Measure):
    """Natural frequency [lanes] [Hz] of a flexible body fixed at its reference nodes, or on supports.

    body      its name
    number    1 is the lowest; without supports up to the number of retained modes
    supports  as in mbd.natural_frequencies, with all degrees of freedom of the mesh; None: the reference nodes, with the
              retained modes

    Where frequencies coincide (their squares agree to 1e-6), none of them is differentiable. The gradient is then the mean of
    their one-sided slopes, a subgradient in the sense of Clarke. `eigenpair_branches` gives these slopes; `MeanFrequency`
    is differentiable there.

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.01, steps=4)
    >>> value, gradient = mbd.Frequency("arm", 1).value_and_gradient(motion)
    >>> value.shape, gradient.shape  # one design, two ply angles
    (torch.Size([1]), torch.Size([1, 2]))
    """

    body: str
    number: int = 1
    supports: Supports | None = None

    def check(self, system: System) -> None:
        _check_number(system, self.body, self.number, self.supports)

    def value(self, motion: Trajectory) -> Tensor:
        self.check(motion.system)
        if self.supports is not None:
            return supported_frequencies(motion, self.body, self.supports, self.number)[:, -1]
        square = eigenvalues(with_stiff_padding(motion.body(self.body).stiffness[0]))[..., self.number - 1]
        return torch.sqrt(square) / (2.0 * math.pi)


def _check_number(system: System, body: str, number: int, supports: Supports | None) -> None:
    modes = flexible_body(system, body).mode_counts[0] if supports is None else 1
    if not is_whole(number) or number < 1 or (supports is None and number > modes):
        allowed = f"1 to {modes}, the modes that every design of {body!r} retains" if supports is None else "1, 2, ..."
        raise InputError("number", number, allowed)
    if supports is not None:
        check_supports(system, body, supports, number)


@dataclass(frozen=True)
class MeanFrequency(Measure):
    """Power mean of natural frequencies [lanes] [Hz]: (mean of f^(2 power))^(1 / (2 power)).

    body      its name
    cluster   numbers of the modes, as (2, 3); 1 is the lowest, up to the number of retained modes
    power     1: root mean square; a large negative number: close to the lowest frequency; a large positive number: close to
              the highest frequency [-]
    supports  as in Frequency

    The mean is differentiable where frequencies of the cluster cross or coincide.
    If a frequency of the cluster is equal to a frequency outside it, the gradient is only a subgradient, as for `Frequency`.

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.01, steps=4)
    >>> low, high = (mbd.Frequency("arm", k)(motion) for k in (1, 2))
    >>> bool(low < mbd.MeanFrequency("arm", (1, 2), power=-4.0)(motion) < high)
    True
    """

    body: str
    cluster: tuple[int, ...]
    power: float = 1.0
    supports: Supports | None = None

    def __post_init__(self) -> None:
        numbers = self.cluster
        if isinstance(numbers, (list, tuple)):
            object.__setattr__(self, "cluster", tuple(numbers))
        if not isinstance(numbers, (list, tuple)) or not numbers or len(set(numbers)) < len(numbers):
            raise InputError("cluster", numbers, "numbers of modes, each once, such as (2, 3)")
        if scalar("power", self.power, "a finite number other than 0") == 0.0:
            raise InputError("power", self.power, "a finite number other than 0")

    def check(self, system: System) -> None:
        for number in self.cluster:
            _check_number(system, self.body, number, self.supports)

    def value(self, motion: Trajectory) -> Tensor:
        self.check(motion.system)
        rows = [number - 1 for number in self.cluster]
        if self.supports is not None:
            frequencies = supported_frequencies(motion, self.body, self.supports, max(self.cluster))[:, rows]
            squares = (2.0 * math.pi * frequencies) ** 2
        else:
            squares = eigenvalues(with_stiff_padding(motion.body(self.body).stiffness[0]))[..., rows]
        powers = torch.logsumexp(self.power * squares.log(), -1) - math.log(len(self.cluster))
        return torch.exp(powers / (2.0 * self.power)) / (2.0 * math.pi)


@dataclass(frozen=True)
class Mass(Measure):
    """Mass [lanes] [kg].

    body  its name; None: all bodies together

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.01, steps=4)
    >>> round(mbd.Mass("arm")(motion).item(), 4)  # 1586 kg/m3 x 0.5 m x 0.05 m x 2 mm
    0.0793
    """

    body: str | None = None

    def check(self, system: System) -> None:
        if self.body is not None:
            system.body(self.body)

    def value(self, motion: Trajectory) -> Tensor:
        names = motion.dynamics.topology.names if self.body is None else [self.body]
        return torch.stack([motion.body(name).mass for name in names]).sum(0)
