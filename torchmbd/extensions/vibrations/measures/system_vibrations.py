"""Measures of small vibrations of the whole system: at rest, or in steady rotation as a whole.

    SystemFrequency(1) >= 40.0                                      [Hz], without damping
    DampingRatio(1, speed=30.0, axis="x") >= 0.02                   -Re s / |s| of the first oscillating pole
    StabilityMargin() <= -0.5                                       largest real part of all poles [1/s], smooth
    CampbellClearance((1, 2, 3), band=(20.0, 30.0)) >= 0.1          distance of frequencies from n times the speed

They are those of the equilibrium near the initial position, with its gravity, loads and pretension, drives at t = 0; the motion
itself does not enter. Numbers count as in mbd.equilibrium(...).frequencies, from 1; free motions come first, with zero.
A state that is none (no equilibrium, rotation that is not steady) is an InputError; so is the derivative of a frequency that is
zero, not a number or one of several that coincide. In an optimization these are statuses of the design.
Checked in tests/contracts/test_responses.py, tests/extensions/vibrations/measures/test_system_vibrations.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchmbd.design.response import Measure
from torchmbd.errors import DesignFailure, InputError, true_or_false
from torchmbd.extensions.vibrations.eigenvalues import NATURAL, POLES
from torchmbd.extensions.vibrations.measures.followed_vibrations import followed_eigenvalue
from torchmbd.extensions.vibrations.spectrum import SWINGS
from torchmbd.extensions.vibrations.steady_states import Shaft, SteadyStates, steady_states
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole, nonnegative, positive, scalar
from torchmbd.multibody.equilibrium.steady_rotation import TURNING


@dataclass(frozen=True, kw_only=True)
class OfVibrations(Measure):
    """A measure of vibrations about a state at rest, or in steady rotation of the whole about an axis of the ground.

    axis, center   of the rotation: "x", "y", "z" or a vector, and a point [m]
    observer       "turning" with the machine, or in the "ground", as in mbd.equilibrium
    """

    drawing: ClassVar[str] = "vibrations"
    axis: str | Sequence[float] = "z"
    center: Sequence[float] = (0.0, 0.0, 0.0)
    observer: str = TURNING

    def __post_init__(self) -> None:
        shaft = self.shaft
        object.__setattr__(self, "axis", shaft.axis)
        object.__setattr__(self, "center", shaft.center)

    def words(self, name: str) -> str:
        """The measure in words: `system frequency 2 at 30 rad/s`."""
        number, speed = getattr(self, "number", 1), getattr(self, "speed", 0.0)
        return f"{name}{f' {number}' * (number > 1)}{f' at {speed:g} rad/s' if speed else ''}"

    @property
    def shaft(self) -> Shaft:
        return Shaft(self.axis, self.center, self.observer)

    def states(self, motion: Trajectory, speeds: Tensor) -> SteadyStates:
        """The states of all designs at speeds [n]; measures of one evaluation share them."""
        known, key = motion.known, ("steady states", self.shaft, tuple(speeds.tolist()))
        if known is not None and key in known:
            return known[key]
        states = steady_states(motion.system, speeds, self.shaft, motion.designs)
        if known is not None:
            known[key] = states
        return states


def _numbers(name: str, numbers: object) -> tuple[int, ...]:
    allowed = "numbers of vibrations, each once, such as (2, 3)"
    if not isinstance(numbers, (list, tuple)) or not numbers:
        raise InputError(name, numbers, allowed)
    for number in numbers:
        number_of(name, number)
    if len(set(numbers)) < len(numbers):
        raise InputError(name, numbers, allowed)
    return tuple(numbers)


def number_of(name: str, number: object) -> None:
    if not is_whole(number) or number < 1:  # pyright: ignore[reportOperatorIssue]
        raise InputError(name, number, "1, 2, ...")


@dataclass(frozen=True)
class SystemFrequency(OfVibrations):
    """Natural frequency [lanes] [Hz] of the whole system, without damping.

    number   1 is the lowest
    cluster  numbers instead, as (2, 3): the power mean of these, which is smooth where they cross or coincide
    power    of that mean, as in Frequencies
    speed    of rotation [rad/s]
    follow   True: `number` selects a shape of the system as it was built. Each design has the vibration with this shape, also
             after a crossing. A design fails if no vibration clearly has this shape (followed_vibrations.py)
    axis, center, observer   of the rotation, as in OfVibrations

    >>> motion = mbd.simulate(mbd.examples.pendulum(length=2.0), 0.01, steps=2)
    >>> round(mbd.vibrations.SystemFrequency(1)(motion).item(), 4)  # sqrt(9.81 / 2) / (2 pi)
    0.3525
    """

    unit: ClassVar[str] = "Hz"
    number: int = 1
    cluster: tuple[int, ...] | None = None
    power: float = 1.0
    speed: float = 0.0
    follow: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        number_of("number", self.number)
        nonnegative("speed", self.speed, "rad/s")
        if self.cluster is not None:
            object.__setattr__(self, "cluster", _numbers("cluster", self.cluster))
            if self.number != 1:
                raise InputError(
                    "number",
                    self.number,
                    "left out with a cluster",
                    state=f"is {self.number}, and cluster is {self.cluster}",
                )
        if true_or_false("follow", self.follow) and self.cluster is not None:
            raise InputError("follow", allowed="given with a number", state=f"is True with cluster {self.cluster}")
        if scalar("power", self.power, "a finite number other than 0") == 0.0:
            raise InputError("power", self.power, "a finite number other than 0")

    def value(self, motion: Trajectory) -> Tensor:
        states = self.states(motion, torch.tensor([float(self.speed)], dtype=torch.float64))
        if self.follow:
            w = followed_eigenvalue(states, motion.system, self.shaft, float(self.speed), NATURAL, self.number)
            return w / (2.0 * math.pi)
        modes = [number - 1 for number in self.cluster or (self.number,)]
        w = states.eigenvalues(NATURAL, modes, self.cluster is not None)[:, 0]
        if self.cluster is None:
            return w[:, 0] / (2.0 * math.pi)
        powers = torch.logsumexp(2.0 * self.power * w.log(), -1) - math.log(len(modes))
        return torch.exp(powers / (2.0 * self.power)) / (2.0 * math.pi)


@dataclass(frozen=True)
class DampingRatio(OfVibrations):
    """Damping ratio -Re s / |s| [lanes] [-] of a pole s of the whole system; negative where the vibration grows.

    number   of the pole, among poles whose imaginary part is at least 1 % of |s|; 1 has the smallest imaginary part
    speed    of rotation [rad/s]
    follow   as in SystemFrequency. With False, poles with nearly equal imaginary parts may exchange their numbers
    axis, center, observer   of the rotation, as in OfVibrations

    >>> body = mbd.RigidBody("load", 2.0, (1.0, 1.0, 1.0))
    >>> rail = mbd.Prismatic(mbd.Ground().at(), body.at(), axis="y")
    >>> spring = mbd.AxialSpringDamper(mbd.Ground().at(), body.at(), axis="y", stiffness=50.0, damping=2.0)
    >>> motion = mbd.simulate(mbd.System([body], [rail], [spring]), 0.01, steps=2)
    >>> round(mbd.vibrations.DampingRatio(1)(motion).item(), 6)  # d / (2 sqrt(k m))
    0.1
    """

    unit: ClassVar[str] = ""
    number: int = 1
    speed: float = 0.0
    follow: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        number_of("number", self.number)
        nonnegative("speed", self.speed, "rad/s")
        true_or_false("follow", self.follow)

    def value(self, motion: Trajectory) -> Tensor:
        states = self.states(motion, torch.tensor([float(self.speed)], dtype=torch.float64))
        if self.follow:
            s = followed_eigenvalue(states, motion.system, self.shaft, float(self.speed), POLES, self.number)
            return -s.real / s.abs()
        poles = states.eigenvalues(POLES)[:, 0]
        ratios = []
        for lane in poles:
            known = lane.detach()
            oscillating = (known.imag > SWINGS * known.abs()).nonzero()[:, 0]
            if len(oscillating) < self.number:
                raise DesignFailure(
                    "number",
                    self.number,
                    f"1 to {len(oscillating)}, the vibrations of the system that oscillate",
                    shown=f"{self.number}",
                )
            s = lane[oscillating[self.number - 1]]
            ratios.append(-s.real / s.abs())
        return torch.stack(ratios)


@dataclass(frozen=True)
class StabilityMargin(OfVibrations):
    """Largest real part [lanes] [1/s] of the poles of the whole system, smooth: below zero the state is stable.

    It exceeds the largest real part by at most ln(number of poles) / sharpness.

    sharpness  of the smooth maximum (SmoothMax) [s]; None: the largest real part itself
    speed      of rotation [rad/s]
    axis, center, observer   of the rotation, as in OfVibrations

    >>> body = mbd.RigidBody("load", 2.0, (1.0, 1.0, 1.0))
    >>> rail = mbd.Prismatic(mbd.Ground().at(), body.at(), axis="y")
    >>> spring = mbd.AxialSpringDamper(mbd.Ground().at(), body.at(), axis="y", stiffness=50.0, damping=2.0)
    >>> motion = mbd.simulate(mbd.System([body], [rail], [spring]), 0.01, steps=2)
    >>> round(mbd.vibrations.StabilityMargin()(motion).item(), 6)  # -d / (2 m)
    -0.5
    """

    unit: ClassVar[str] = "1/s"
    sharpness: float | None = None
    speed: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        nonnegative("speed", self.speed, "rad/s")
        if self.sharpness is not None:
            positive("sharpness", self.sharpness, "s")

    def value(self, motion: Trajectory) -> Tensor:
        states = self.states(motion, torch.tensor([float(self.speed)], dtype=torch.float64))
        growth = states.eigenvalues(POLES, None, self.sharpness is not None)[:, 0].real
        if not growth.shape[1]:
            raise DesignFailure(
                "system",
                allowed="must have at least one degree of freedom",
                noun="the system",
                state="has no vibrations, because its joints leave no degree of freedom",
            )
        if self.sharpness is not None:
            return torch.logsumexp(self.sharpness * growth, -1) / self.sharpness
        # A conjugate pair counts once: the member with the larger imaginary part comes last.
        size = growth.shape[1]
        worst = size - 1 - growth.detach().flip(-1).argmax(-1)
        return growth.gather(1, worst[:, None])[:, 0]


@dataclass(frozen=True)
class CampbellClearance(OfVibrations):
    """Relative distances [lanes, rows] [-] of frequencies f from n times the speed over a band of speeds; use >= as limit.

    For each frequency f and each order n the distance is the larger of min(e) and min(-e), with e = 2 pi f / (n speed) - 1
    over the sample speeds. It is positive if the frequency stays above, or stays below, the order line, and negative if it
    crosses the line.

    orders    n, as (1, 2, 3)
    band      (lowest, highest) speed [rad/s], positive
    modes     numbers of the frequencies
    points    number of equally spaced sample speeds, ends included; the curves must be monotonic between them

    axis, center, observer   of the rotation, as in OfVibrations: "turning" for loads that stand still while blades turn, or
              "ground" for unbalance
    Rows: all orders of the first frequency, then those of the second, ...

    >>> disk = mbd.RigidBody("disk", 2.0, (0.02, 0.01, 0.01))
    >>> bearing = mbd.Bushing(mbd.Ground().at(), disk.at(), (5e4, 8e3, 8e3), turning_stiffness=(0.0, 30.0, 30.0))
    >>> motion = mbd.simulate(mbd.System([disk], forces=[bearing]), 1e-4, steps=2)
    >>> clear = mbd.vibrations.CampbellClearance((1,), band=(20.0, 30.0), modes=(3,), points=3, axis="x", observer="ground")
    >>> round(clear(motion).item(), 3)  # sqrt(8e3 / 2) = 63.2 rad/s is 111 % above 30
    1.108
    """

    unit: ClassVar[str] = ""
    orders: Sequence[float] = (1.0, 2.0, 3.0)
    band: tuple[float, float] = (1.0, 2.0)
    modes: Sequence[int] = (1, 2, 3)
    points: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "modes", _numbers("modes", self.modes))
        if not isinstance(self.orders, (list, tuple)) or not self.orders:
            raise InputError("orders", self.orders, "positive numbers, such as (1, 2, 3)")
        for order in self.orders:
            positive("orders", order, "")
        object.__setattr__(self, "orders", tuple(self.orders))
        low, high = positive_band("band", self.band)
        object.__setattr__(self, "band", (low, high))
        if not is_whole(self.points) or self.points < 2:
            raise InputError("points", self.points, "2, 3, ...")

    @property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return len(self.modes) * len(self.orders)

    def value(self, motion: Trajectory) -> Tensor:
        speeds = torch.linspace(*self.band, self.points, dtype=torch.float64)
        w = self.states(motion, speeds).eigenvalues(NATURAL, [number - 1 for number in self.modes])
        lines = torch.tensor(self.orders, dtype=torch.float64)[:, None] * speeds
        distance = w.mT[:, :, None] / lines - 1.0  # [lanes, modes, orders, speeds]
        return torch.maximum(distance.amin(-1), (-distance).amin(-1)).flatten(1)


def rising(name: str, band: object) -> tuple[float, float]:
    """Two rising numbers."""
    if not isinstance(band, (list, tuple)) or len(band) != 2:
        raise InputError(name, band, "two rising numbers")
    low, high = (scalar(name, x) for x in band)
    if not low < high:
        raise InputError(name, band, "two rising numbers")
    return low, high


def positive_band(name: str, band: object) -> tuple[float, float]:
    """Two rising positive numbers."""
    low, high = rising(name, band)
    if not low > 0.0:
        raise InputError(name, band, "two rising positive numbers")
    return low, high
