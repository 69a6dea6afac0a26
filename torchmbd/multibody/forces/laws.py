"""Laws of actions: generalized force f(s, s', t) in the direction of growing s.

    Spring     f = -k (s - s0) - c s'
    Table      f = piecewise linear in s through knots, constant outside, - c s'
    Pieces     f = a_i + k_i s on intervals, jumps smoothed over a stated width, - c s'
    OfTime     f = g(t)
    Friction   f = -f0 tanh(s' / v0)
    Scaled     f = factor g(s, s', t), g any law

Numbers of Spring and Friction, and the factor of Scaled, may be design variables: `Spring(mbd.variable(2e3))`
(parametric_law.py). Where a force is a function of time alone, the law g of Scaled is g(t).

A law is a frozen dataclass. `data_fields` names its fields that are data of compiled code, and may be design variables; all
else is compiled. Such a law states `slopes`, and consists of + - * / and functions of math/elementwise.py, which take pairs.
Any elementwise torch function of (s, s', t) is a law as well. `center`: middle of the range of an angle, half a turn to both
sides.
Checked in tests/multibody/forces/test_laws.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.errors import InputError, Path, user_line
from torchmbd.math.checked_numbers import reals, scalar
from torchmbd.math.elementwise import reciprocal, tanh
from torchmbd.math.gradients import refuse_gradients, refuse_lost_gradients
from torchmbd.math.pair import Pair, linear
from torchmbd.math.torch_law import require_differentiable
from torchmbd.math.variable import number
from torchmbd.multibody.joints.laws import finite

Slopes = tuple[Tensor, Tensor]


def data_fields(law: Any) -> tuple[str, ...]:
    """Names of the fields of a law that are data of compiled code."""
    return getattr(law, "data_fields", ())


@dataclass(frozen=True)
class Spring:
    """Linear spring and damper: stiffness k, damping c, rest s0."""

    stiffness: float = 0.0
    damping: float = 0.0
    rest: float = 0.0
    data_fields: ClassVar[tuple[str, ...]] = ("stiffness", "damping", "rest")

    def __post_init__(self) -> None:
        for name in self.data_fields:
            x = getattr(self, name)
            if not getattr(x, "shape", ()):  # else data of a batch of designs, which were checked
                scalar(name, number(x))

    @property
    def center(self) -> float:
        return self.rest

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return -self.stiffness * (s - self.rest) - self.damping * rate

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> Slopes:
        """Derivatives with respect to s and s'."""
        zero = torch.zeros_like(s)
        return zero - self.stiffness, zero - self.damping


@dataclass(frozen=True)
class Scaled:
    """Another law times a factor: the strength of an actuator."""

    factor: float
    law: Callable[..., Tensor]
    data_fields: ClassVar[tuple[str, ...]] = ("factor",)

    @property
    def center(self) -> float:
        return getattr(self.law, "center", 0.0)

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return self.factor * self.law(s, rate, t)


@dataclass(frozen=True)
class Table:
    """Continuous, piecewise linear: knots (s, f) with growing s, constant outside; and damping c."""

    knots: tuple[tuple[float, float], ...]
    damping: float = 0.0
    center: float = 0.0

    def __post_init__(self) -> None:
        knots = reals("knots", self.knots)
        rising = knots.dim() == 2 and len(knots) > 1 and knots.shape[1] == 2 and bool((knots[:, 0].diff() > 0).all())
        if not rising or not bool(torch.isfinite(knots).all()):
            raise InputError(
                "knots", self.knots, "two or more pairs (s, f) with growing s, finite", state=f"are {self.knots!r}"
            )
        object.__setattr__(self, "knots", tuple((s, f) for s, f in knots.tolist()))
        scalar("damping", self.damping)

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        total = self.knots[0][1] - self.damping * rate
        for knot, bend in self._bends():
            total = total + bend * torch.clamp_min(s - knot, 0.0)
        return total

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> Slopes:
        """Derivatives with respect to s and s'."""
        by_s = torch.zeros_like(s)
        for knot, bend in self._bends():
            by_s = by_s + bend * (s > knot).to(s.dtype)
        return by_s, torch.full_like(s, -self.damping)

    def _bends(self) -> list[tuple[float, float]]:
        """Where the slope changes, and by how much."""
        x, f = zip(*self.knots, strict=True)
        k = [(f[i + 1] - f[i]) / (x[i + 1] - x[i]) for i in range(len(x) - 1)]
        return list(zip(x, [b - a for a, b in zip([0.0, *k], [*k, 0.0], strict=True)], strict=True))


@dataclass(frozen=True)
class Pieces:
    """Piecewise linear with jumps: f = intercepts[i] + inclines[i] s between borders[i - 1] and borders[i].

    borders  growing, one less than pieces
    width    every jump is spread over s = border +- width, by a cubic step; results depend on the width
    """

    borders: tuple[float, ...]
    intercepts: tuple[float, ...]
    inclines: tuple[float, ...]
    width: float
    damping: float = 0.0
    center: float = 0.0

    def __post_init__(self) -> None:
        n = len(self.borders)
        if len(self.intercepts) != n + 1 or len(self.inclines) != n + 1 or not self.width > 0:
            raise InputError(
                "borders",
                allowed=f"must have {n + 1} intercepts, {n + 1} inclines and a positive width",
                state=f"are {n}, with {len(self.intercepts)} intercepts, {len(self.inclines)} inclines, width {self.width!r}",
            )
        for x in (*self.borders, *self.intercepts, *self.inclines, self.width, self.damping):
            scalar("a number of Pieces", x)
        if any(not b - a >= 2.0 * self.width for a, b in pairwise(self.borders)):
            raise InputError(
                "borders",
                self.borders,
                f"numbers in ascending order, at least 2 width = {2 * self.width} apart",
            )

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        total = self.intercepts[0] + self.inclines[0] * s - self.damping * rate
        for i, border in enumerate(self.borders):
            u = torch.clamp((s - border) / (2.0 * self.width) + 0.5, 0.0, 1.0)
            total = total + u * u * (3.0 - 2.0 * u) * self._change(i, s)
        return total

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> Slopes:
        """Derivatives with respect to s and s'."""
        by_s = torch.full_like(s, self.inclines[0])
        for i, border in enumerate(self.borders):
            u = torch.clamp((s - border) / (2.0 * self.width) + 0.5, 0.0, 1.0)
            rising = 3.0 * u * (1.0 - u) / self.width
            by_s = by_s + rising * self._change(i, s)
            by_s = by_s + u * u * (3.0 - 2.0 * u) * (self.inclines[i + 1] - self.inclines[i])
        return by_s, torch.full_like(s, -self.damping)

    def _change(self, i: int, s: Tensor) -> Tensor:
        return self.intercepts[i + 1] - self.intercepts[i] + (self.inclines[i + 1] - self.inclines[i]) * s


@dataclass(frozen=True)
class OfTime:
    """A force that is a torch function of time alone, or constant."""

    law: Callable[..., Tensor] | float
    factor: float = 1.0

    @property
    def data_fields(self) -> tuple[str, ...]:
        return () if callable(self.law) else ("law", "factor")

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        f = self.law if not callable(self.law) else self.law(t) if t.dim() != 1 and t.numel() == 1 else self._at_each(t)
        return self.factor * f + linear(torch.zeros_like, s)

    def _at_each(self, t: Tensor) -> Tensor:
        """The forces at times t [..., lanes], by one call of the function for each."""
        assert callable(self.law)
        return torch.stack([self.law(x) for x in t.flatten()]).reshape(t.shape)

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> Slopes:
        """Derivatives with respect to s and s'."""
        return torch.zeros_like(s), torch.zeros_like(s)


@dataclass(frozen=True)
class Gap:
    """A one-sided stop: f = k d - c d' s' for the penetration d = limit - s > 0 (sign +1), or s - limit (sign -1).

    smooth  the stiffness rises from zero over this penetration, so that the law has a continuous slope
    """

    stiffness: float
    limit: float = 0.0
    sign: float = 1.0
    damping: float = 0.0
    smooth: float = 0.0
    center: float = 0.0

    def __post_init__(self) -> None:
        for name in ("stiffness", "limit", "damping", "smooth"):
            least = -math.inf if name == "limit" else 0.0
            if not scalar(name, getattr(self, name)) >= least:
                raise InputError(name, getattr(self, name), "zero or positive", noun=f"{name} of a Gap")
        if self.sign not in (1.0, -1.0):
            raise InputError("sign", self.sign, "1.0 or -1.0", noun="sign of a Gap")

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        depth, share, _ = self._depth(s)
        return self.sign * self.stiffness * depth * share - self.damping * share * rate

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> Slopes:
        """Derivatives with respect to s and s'."""
        depth, share, rising = self._depth(s)
        inside = (depth > 0).to(s.dtype)
        by_s = -self.stiffness * (share * inside + depth * rising) + self.sign * self.damping * rising * rate
        return by_s, -self.damping * share

    def _depth(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Penetration, the share of stiffness and damping that acts there, and its derivative."""
        depth = torch.clamp_min(self.sign * (self.limit - s), 0.0)
        if not self.smooth:
            return depth, (depth > 0).to(s.dtype), torch.zeros_like(s)
        u = torch.clamp_max(depth / self.smooth, 1.0)
        return depth, u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u) / self.smooth


@dataclass(frozen=True)
class Friction:
    """Dry friction, smoothed: f = -force tanh(s' / speed). Below `speed` bodies creep instead of sticking."""

    force: float | Tensor
    speed: float | Tensor
    center: float = 0.0
    data_fields: ClassVar[tuple[str, ...]] = ("force", "speed")
    positive: ClassVar[tuple[str, ...]] = ("force", "speed")

    def __post_init__(self) -> None:
        for name in self.positive:
            x = getattr(self, name)
            if getattr(x, "shape", ()):
                continue  # data of a batch of designs, which were checked
            if not scalar(name, number(x)) > 0.0:
                raise InputError(
                    name, number(x), "positive, or mbd.variable(...) of such a number", noun=f"{name} of a Friction"
                )

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return -self.force * tanh(rate * reciprocal(self.speed))

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> Slopes:
        """Derivatives with respect to s and s'."""
        inverse = reciprocal(self.speed)
        share = tanh(rate * inverse)
        return torch.zeros_like(s), -self.force * inverse * (1.0 - share * share)


# What of a law of a force may be a design variable; part of messages.
VARIABLES = (
    "numbers of a Spring or a Friction, the factor of Scaled and data_fields of a law, given to a force element as "
    "mbd.variable(...); constant tensors"
)

LAWS: tuple[type, ...] = (Spring, Table, Pieces, OfTime, Gap, Friction)


def check_law(name: str, law: Any) -> Any:
    """The law as it is, after one evaluation at zero; InputError names its force element."""
    if not callable(law):
        raise InputError((name, "law"), law, "a torch function of (s, s', t)")
    if data_fields(law):
        check_data_fields(name, law)
    zero = torch.zeros(1, 1, 1, dtype=torch.float64)
    f = evaluate_law(name, law, zero, zero, zero[0, 0, 0])
    if not isinstance(f, Tensor) or f.shape != zero.shape or not bool(torch.isfinite(f).all()):
        raise InputError(
            (name, "law"),
            law,
            "must give a finite tensor of the shape of s, [1, 1, lanes]",
            state=f"gives {f!r} at s = s' = t = 0",
        )
    if not hasattr(law, "slopes") and not isinstance(law, Scaled):
        function: Any = law
        allowed = "a torch function of (s, s', t), or mbd.forces.Table of points"

        def by_coordinate(s: Tensor) -> Tensor:
            return function(s.reshape(1, 1, 1), zero, zero[0, 0, 0])[0, 0, 0]

        def by_rate(rate: Tensor) -> Tensor:
            return function(zero, rate.reshape(1, 1, 1), zero[0, 0, 0])[0, 0, 0]

        for argument in (by_coordinate, by_rate):
            require_differentiable((name, "law"), argument, allowed, signed=True)
    return law


def check_data_fields(name: str, law: Any) -> None:
    """InputError for a law whose `data_fields` cannot be data of compiled code."""
    names, kind = data_fields(law), type(law)
    places = {f.name for f in fields(law)} if is_dataclass(law) else set()
    rule = "a frozen dataclass with data_fields, a tuple of names of its fields, and slopes(s, s', t)"
    if not isinstance(names, tuple) or not set(names) <= places:
        raise InputError(
            (name, "law", "data_fields"),
            names,
            rule,
            state=f"are {names!r}",
            noun=f"data_fields of the law of {name!r} ({kind.__name__})",
        )
    if isinstance(law, Scaled):
        return
    inner = getattr(law, "law", None) if "law" not in names else None
    others = {x: getattr(law, x) for x in places - {*names}}
    if not hasattr(law, "slopes") or callable(inner) or not all(isinstance(x, Hashable) for x in others.values()):
        raise InputError(
            (name, "law", "data_fields"),
            allowed=rule,
            hint="a tuple for a list, or mbd.forces.Scaled around another law",
            state="has data_fields, but no slopes, or a field that holds a law or a list",
            noun=f"the law of {name!r} ({kind.__name__})",
        )
    numbers = {x: getattr(law, x) for x in names}
    numbers = {x: y.item() if isinstance(y, Tensor) and y.numel() == 1 else y for x, y in numbers.items()}
    plain: Any = replace(law, **numbers)  # pyright: ignore[reportArgumentType]
    state = torch.zeros(1, 2, 1, dtype=torch.float64)
    try:
        plain(Pair(state), Pair(state), state[0, 0, 0])
    except TypeError as error:
        raise InputError(
            (name, "law", "data_fields"),
            allowed="must use + - * / and the functions of torchmbd.math.elementwise alone",
            state=f"has data_fields and does not take pairs of a number and its tangents: {error} in {user_line(error)}",
            noun=f"the law of {name!r} ({kind.__name__})",
        ) from error


def evaluate_law(name: str, law: Callable[..., Any], *at: Tensor) -> Any:
    """The value of a law at some arguments; InputError if it raises, or has parameters without a gradient."""
    try:
        with torch.inference_mode(False), torch.enable_grad():
            f = law(*at)
    except Exception as error:  # a function of users may raise any error
        raise InputError(
            (name, "law"),
            allowed=f"a torch function of {len(at)} tensors",
            state=f"raises {error!r} in {user_line(error)}",
        ) from error
    refuse_lost_gradients((name, "law"), f, VARIABLES)
    refuse_gradients((name, "law"), f, VARIABLES)
    return f


def three_numbers(name: str | Path, x: Any) -> list[Any]:
    """The argument x, three finite numbers, as a list; each may be a design variable."""
    values = _finite_numbers(name, x)
    if len(values) != 3:
        raise InputError(name, x, "three finite numbers; each may be mbd.variable(...)")
    return values


def one_or_three_numbers(name: str | Path, x: Any) -> list[Any]:
    """The argument x, three finite numbers or one for all, as a list; each may be a design variable."""
    single = isinstance(x, (int, float)) or (isinstance(x, Tensor) and x.dim() == 0)
    values = _finite_numbers(name, [x] * 3 if single else x)
    if len(values) != 3:
        raise InputError(name, x, "three finite numbers, or one for all; each may be mbd.variable(...)")
    return values


def _finite_numbers(name: str | Path, items: Any) -> list[Any]:
    """The items as a list; empty if they are not finite numbers."""
    try:
        return [finite(name, y) for y in items]
    except (TypeError, InputError):
        return []
