"""Speeds and parameters at which something happens to the vibrations of the whole system, solved for: an implicit gradient.

    CriticalSpeed       w(speed, b) = order speed          w: a natural frequency that a fixed observer sees (whirl.py)
    StabilityLimit      max Re s(p, b) = 0                 s: poles, p: a parameter, such as a load, or the speed

    dp/db = -(dg/db) / (dg/dp)     of g(p, b) = 0

The root is bracketed between neighbors of a grid, then refined by Newton's method within the bracket.
Checked in tests/contracts/test_responses.py, tests/extensions/vibrations/measures/test_critical_values.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.errors import DesignFailure, InputError, one_of
from torchmbd.extensions.vibrations.eigenvalues import NATURAL, POLES
from torchmbd.extensions.vibrations.measures.system_vibrations import OfVibrations, number_of, positive_band, rising
from torchmbd.extensions.vibrations.steady_states import Shaft, SteadyStates, steady_states
from torchmbd.extensions.vibrations.whirl import SeenFromGround, Whirl
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole, positive, scalar
from torchmbd.math.gradients import untransformed
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.bodies.flexible import FlexibleBody
from torchmbd.multibody.equilibrium.steady_rotation import GROUND, TURNING
from torchmbd.multibody.system import System

_STEPS = 60  # of Newton's method; bisection alone takes 50 to double precision
_ACCURACY = 1e-12  # of the root, relative
_STILL = 1e-9  # share of |s| below which a real part is rounding: the pole neither decays nor grows
_ROUNDING = 1e-13  # of poles, as a share of the largest
SPEED = "speed"
_BALANCED = "a balanced rotor: an unbalance has no steady state near a critical speed"  # hint
# Of a speed: at a critical speed of unbalance a shaft stands still in turning axes, and the zero has no derivative. What a
# fixed observer sees is smooth there: a cubic through four speeds beside it has it to the fourth power of this share.
_BESIDE = 1e-2

Designs = dict[str, Tensor]
Function = Callable[[Tensor, Designs, Any, bool], Tensor]


def root(
    g: Function,
    designs: Designs,
    bracket: Callable[[Designs], tuple[float, float, Any]],
    name: str,
    accuracy: float = _ACCURACY,
) -> Tensor:
    """The zero p [] of g(p, designs, more, mean); a differentiable function of the designs.

    g         with `mean` eigenvalues that coincide have the mean of their derivatives, which is enough for the search
    bracket   of constant designs: two numbers between which g has two signs, and what else g takes
    """
    tensors = list(designs.values())
    p, slope, more = outside_transforms(
        lambda *x: _search(g, dict(zip(designs, x, strict=True)), bracket, accuracy), *tensors
    )
    if not slope:
        raise DesignFailure(
            "between",
            p,
            "a crossing of two curves",
            noun=name,
            state=f"has no derivative at {p:g}, where the two curves touch without crossing",
        )
    y = g(torch.tensor(p, dtype=torch.float64), designs, more, False)
    return p - (y - y.detach()) / slope


def _search(
    g: Function, designs: Designs, bracket: Callable[[Designs], tuple[float, float, Any]], accuracy: float
) -> tuple[float, float, Any]:
    """p with g(p) = 0, the derivative of g by p there, and what else g takes."""
    designs = {key: x.detach() for key, x in designs.items()}
    with torch.no_grad():
        a, b, more = bracket(designs)

    def at(p: float) -> tuple[float, float]:
        with torch.enable_grad():
            x = torch.tensor(p, dtype=torch.float64, requires_grad=True)
            y = g(x, designs, more, True)
        return float(y), float(torch.autograd.grad(y, x)[0])

    p, (y, slope) = a, at(a)
    below = y < 0.0
    for _ in range(_STEPS):
        new = p - y / slope if slope else a
        new = new if a < new < b else 0.5 * (a + b)
        if abs(new - p) <= accuracy * max(abs(a), abs(b)):
            return new, slope, more
        p = new
        y, slope = at(p)
        a, b = (p, b) if (y < 0.0) == below else (a, p)
    return p, slope, more


def _of_lanes(motion: Trajectory, of_lane: Callable[[Designs], Tensor]) -> Tensor:
    lanes = [{name: x[lane : lane + 1] for name, x in motion.designs.items()} for lane in range(motion.lanes)]
    return torch.stack([of_lane(designs) for designs in lanes])


def _check_points(points: object) -> None:
    if not is_whole(points) or points < 2:  # pyright: ignore[reportOperatorIssue]
        raise InputError("points", points, "2, 3, ...")


@dataclass(frozen=True)
class CriticalSpeed(OfVibrations):
    """A speed [lanes] [rad/s] at which a natural frequency, as a fixed observer sees it, is a multiple of the speed.

    number    1 is the lowest within `between`
    order     the multiple: 1 for unbalance, which turns with the shaft
    between   (lowest, highest) speed that is searched [rad/s], positive
    points    number of equally spaced speeds of the grid; the search misses two crossings of one frequency between neighbors
    axis, center   of the rotation, as in OfVibrations
    observer  rigid bodies and flexible beams are computed in the axes of this observer: "ground", or "turning" with the
              machine. With both, the critical speed is that of a fixed observer. Bodies with modes are computed in axes
              that turn with them, so the bearings must be isotropic

    The rotor must be balanced: an unbalance bends it without limit near a critical speed, so there is no steady state.
    Leave out the eccentricity here, and give it in the motion that shows its response.

    Raises InputError if there are fewer than `number` critical speeds. Also raises it for blades and shafts of non-circular
    section, because a fixed observer sees several frequencies of one vibration. Use `CampbellClearance` for loads on a
    turning blade.

    >>> disk = mbd.RigidBody("disk", 2.0, (0.02, 0.01, 0.01))
    >>> bearing = mbd.Bushing(mbd.Ground().at(), disk.at(), (5e4, 8e3, 5e3), turning_stiffness=(0.0, 30.0, 30.0))
    >>> motion = mbd.simulate(mbd.System([disk], forces=[bearing]), 1e-4, steps=2)
    >>> second = mbd.vibrations.CriticalSpeed(2, between=(10.0, 90.0), axis="x", observer="ground")
    >>> round(second(motion).item(), 6)  # sqrt(5e3 / 2) [rad/s]
    50.0
    """

    unit: ClassVar[str] = "rad/s"
    observer: str = field(default=GROUND, kw_only=True)
    number: int = 1
    order: float = 1.0
    between: tuple[float, float] = (1.0, 1000.0)
    points: int = 12

    def __post_init__(self) -> None:
        super().__post_init__()
        number_of("number", self.number)
        positive("order", self.order, "")
        object.__setattr__(self, "between", positive_band("between", self.between))
        _check_points(self.points)

    def value(self, motion: Trajectory) -> Tensor:
        return _of_lanes(motion, lambda designs: self._of_lane(motion.system, designs))

    def shaft_of(self, system: System) -> Shaft:
        """The axis of rotation, with the observer whose axes the computation uses."""
        modal = any(isinstance(body, FlexibleBody) for body in system.bodies)
        return replace(self.shaft, observer=TURNING if modal else self.observer)

    def _of_lane(self, system: System, designs: Designs) -> Tensor:
        shaft = self.shaft_of(system)
        turning = shaft.observer == TURNING
        last: list[SeenFromGround] = []

        def seen(speed: Tensor, designs: Designs, number: int, mean: bool) -> Tensor:
            """The frequency that a fixed observer sees [rad/s], out of those in turning axes beside the speed."""
            speeds = speed * (1.0 + _BESIDE * torch.tensor([-2.0, -1.0, 1.0, 2.0], dtype=torch.float64))
            states = steady_states(system, speeds, shaft, designs)
            if mean:
                last[:] = [_seen_from_ground(system, states, shaft, speeds, number)]
            w = states.eigenvalues(NATURAL, last[0] if mean else last[0].chosen, mean=mean)[0]
            w = (w.gather(1, last[0].places) + last[0].orders * speeds[:, None]).abs()[:, 0]
            return (4.0 * (w[1] + w[2]) - w[0] - w[3]) / 6.0

        def g(speed: Tensor, designs: Designs, number: int, mean: bool) -> Tensor:
            if turning:
                return seen(speed, designs, number, mean) - self.order * speed
            states = steady_states(system, speed[None], shaft, designs)
            return states.eigenvalues(NATURAL, [number], mean=mean)[0, 0, 0] - self.order * speed

        accuracy = _BESIDE**4 if turning else _ACCURACY
        return root(g, designs, lambda designs: self._bracket(system, designs, shaft), "the critical speed", accuracy)

    def _bracket(self, system: System, designs: Designs, shaft: Shaft) -> tuple[float, float, int]:
        """Two speeds around the crossing, and the number of the frequency from 0."""
        speeds = torch.linspace(*self.between, self.points, dtype=torch.float64)
        try:
            states = steady_states(system, speeds, shaft, designs)
        except DesignFailure as failure:
            failure.hint = failure.hint or _BALANCED
            raise
        if shaft.observer == TURNING:
            seen = _seen_from_ground(system, states, shaft, speeds)
            w = states.eigenvalues(NATURAL, seen)[0]
            several = seen.orders.isnan() & ~w.isnan()
            if bool(several.any()):
                i, k = several.nonzero()[0].tolist()
                raise DesignFailure(
                    "observer",
                    shaft.observer,
                    "used for a round shaft, whose vibrations have one frequency for an observer at rest",
                    noun="CriticalSpeed",
                    state=f"is not defined: vibration {k + 1} has several frequencies for an observer at rest, at "
                    f"{float(speeds[i]):g} rad/s",
                    hint=f"CampbellClearance for blades; {_BALANCED}",
                )
            w = (w + seen.orders * speeds[:, None]).abs().sort(dim=1).values
        else:
            w = states.eigenvalues(NATURAL)[0]
        g = w - self.order * speeds[:, None]
        crossings = []
        ends = g[:-1].isnan() != g[1:].isnan()
        for i, k in (ends | ((g[:-1] < 0.0) != (g[1:] < 0.0))).nonzero().tolist():
            here, there = float(g[i, k]), float(g[i + 1, k])
            if math.isnan(here + there):  # no frequency without damping: a crossing is neither seen nor excluded
                crossings.append((float(speeds[i]), i, k))
                continue
            share = here / (here - there)
            crossings.append((float(speeds[i]) + share * float(speeds[i + 1] - speeds[i]), i, k))
        if len(crossings) < self.number:
            low, high = self.between
            raise DesignFailure(
                "between",
                self.between,
                "a range that contains it",
                noun=f"critical speed {self.number} of order {self.order:g}",
                state=f"is not between {low:g} and {high:g} rad/s, which contains {len(crossings)}",
                hint="another range, or more points",
            )
        crossings = sorted(crossings)[: self.number]
        for _, i, k in crossings:
            if bool(g[i : i + 2, k].isnan().any()):
                raise DesignFailure(
                    "between",
                    self.between,
                    "a range in which the shaft is stable without damping",
                    noun=f"critical speed {self.number}",
                    state=f"is unknown, because vibration {k + 1} becomes unstable without damping between "
                    f"{float(speeds[i]):g} and {float(speeds[i + 1]):g} rad/s",
                    hint="another range",
                )
        _, i, k = crossings[-1]
        return float(speeds[i]), float(speeds[i + 1]), k


def _seen_from_ground(
    system: System, states: SteadyStates, shaft: Shaft, speeds: Tensor, number: int | None = None
) -> SeenFromGround:
    modes = {name: x.reshape(-1, *x.shape[-3:])[0] for name, x in states.modes.items()}
    whirl = Whirl(system, states.dynamics.topology, modes, shaft)
    return SeenFromGround(whirl, states.q, speeds, states.sizes, number)


@dataclass(frozen=True)
class StabilityLimit(OfVibrations):
    """The smallest value [lanes] of a parameter, in its unit, at which vibrations begin to grow: a flutter load or speed.

    parameter   name of a parameter with one entry, such as "push.x"; or "speed", the speed of rotation [rad/s]
    between     (lowest, highest) value that is searched
    points      values of the grid, equally spaced
    axis, center, observer   of the rotation, as in OfVibrations

    The system needs damping. Without damping, poles stay on the imaginary axis until two poles meet, and the value at which
    they meet has no derivative. Raises InputError if no vibration begins to grow.

    >>> masses = {"a": (2.0, 1.0), "b": (1.0, 2.0)}  # [kg], place along x [m]
    >>> links = [mbd.RigidBody(name, m, (1e-7,) * 3, position=(x, 0, 0)) for name, (m, x) in masses.items()]
    >>> ends = [(mbd.Ground().at(), links[0].at(-1.0, 0, 0)), (links[0].at(), links[1].at(-1.0, 0, 0))]
    >>> hinges = [mbd.Revolute(*pair, axis="z") for pair in ends]
    >>> springs = [mbd.RotationalSpringDamper(*pair, axis="z", stiffness=3.0, damping=0.2) for pair in ends]
    >>> tip = links[1].at(0, 0, 0, axes=torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)))
    >>> push = mbd.Force(tip, (mbd.variable(1.0), 0.0, 0.0), axes="frame", name="push")
    >>> motion = mbd.simulate(mbd.System(links, hinges, [*springs, push]), 1e-4, steps=2)
    >>> round(mbd.vibrations.StabilityLimit("push.x", (1.0, 6.0), points=6)(motion).item(), 4)  # Ziegler: 41/28 k + c^2 / 2 [N]
    4.4129
    """

    unit: ClassVar[str] = ""  # that of the parameter, which is not known here
    parameter: str = SPEED
    between: tuple[float, float] = (0.0, 1.0)
    points: int = 12

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.parameter, str):
            raise InputError("parameter", self.parameter, "'speed', or the name of a parameter of the system")
        low, high = (scalar("between", x) for x in rising("between", self.between))
        object.__setattr__(self, "between", (low, high))
        _check_points(self.points)

    def check(self, system: System) -> None:
        if self.parameter != SPEED:
            names = [name for name, x in system.named_parameters() if x.numel() == 1]
            one_of("parameter of one number", self.parameter, [SPEED, *names])

    def value(self, motion: Trajectory) -> Tensor:
        self.check(motion.system)
        return _of_lanes(motion, lambda designs: self._of_lane(motion.system, designs))

    def _of_lane(self, system: System, designs: Designs) -> Tensor:
        def g(p: Tensor, designs: Designs, _: None, mean: bool) -> Tensor:
            poles = self._poles(system, p[None], designs, mean)[0]
            return poles[int(untransformed(poles).real.argmax())].real

        return root(g, designs, lambda designs: self._bracket(system, designs), "the limit of stability")

    def _poles(self, system: System, p: Tensor, designs: Designs, mean: bool = True) -> Tensor:
        """Poles [n, 2 freedoms] at values p [n] of one design."""
        if self.parameter == SPEED:
            return steady_states(system, p, self.shaft, designs).eigenvalues(POLES, None, mean=mean)[0]
        like = system.get_parameter(self.parameter)
        wide = {name: x.expand(len(p), *x.shape[1:]) for name, x in designs.items() if name != self.parameter}
        wide[self.parameter] = p.reshape(-1, *like.shape)
        return steady_states(system, [0.0], self.shaft, wide).eigenvalues(POLES, None, mean=mean)[:, 0]

    def _bracket(self, system: System, designs: Designs) -> tuple[float, float, None]:
        """Two values around the limit."""
        values = torch.linspace(*self.between, self.points, dtype=torch.float64)
        poles = self._poles(system, values, designs)
        size = poles.abs().nan_to_num(posinf=0.0)  # modes that a design does not retain have infinite ones
        rounding = torch.maximum(_STILL * size, _ROUNDING * size.amax(1, keepdim=True))
        grows, decays = (poles.real > rounding).any(1), (poles.real < -rounding).all(1)
        for i in range(len(values) - 1):
            if bool(grows[i + 1] and decays[i]):
                return float(values[i]), float(values[i + 1]), None
            if bool(grows[i + 1] and not grows[i]):
                raise DesignFailure(
                    "parameter",
                    self.parameter,
                    "a parameter of a system whose vibrations are all damped and which cannot move freely",
                    noun=f"{self.parameter} = {float(values[i]):g}",
                    state="has a vibration that neither decays nor grows, so that a limit of stability cannot be found",
                )
        low, high = self.between
        state = "vibrations grow at all values" if bool(grows.all()) else "no vibration begins to grow"
        raise DesignFailure(
            "between",
            self.between,
            "must have a limit of stability",
            noun=f"{self.parameter} between {low:g} and {high:g}",
            state=f"has no limit of stability, because {state}",
            hint="another range, or more points",
        )
