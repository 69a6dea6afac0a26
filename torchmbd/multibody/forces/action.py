"""Actions: the few kinds of applied generalized forces that every force element is a list of.

An action has a coordinate s of the vectors attached to its bodies and a law f(s, s', t). By virtual work it pulls with

    force on each vector = f ds/dvector          power = f s'

so its forces on bodies follow as those of a constraint, momentum is conserved, and its power is that of the law.

    kind      coordinate                                  arguments                   unit of f
    Length    |g_b - g_a|                                 point, point                N
    Along     (g_b - g_a) . u                             point, point, axis u        N
    Turn      angle of x_b from x_a towards y_a           axis x_a, axis y_a, axis    N m
    Push      none: a force along u                       point, axis u               N
    Twist     none: a torque about u                      axis u, triad of the body   N m
    Spin      none, rate: spin of b from a about u        axis u, triads of a and b   N m

The contract of a kind:

    direction(vectors)   force of f = 1 on each argument [3, n, ...]; the gradient of s where there is an s
    measure(vectors)     s [n, ...]; laws of kinds without s get s = s' = 0, those of Spin s = 0, as its rate has no coordinate

No other code is needed for a force: design tangents follow from pairs, the iteration matrix from the slopes of the law.
The angle of `Turn` is within half a turn of the `center` of its law (0 by default).
A law is elementwise: its arguments s and s' have the shape [1, 1, lanes], and so has its result. It may state its derivatives
by s and s' (`slopes`, as the laws of laws.py do); otherwise they follow by forward mode.
The law of an action that a controller reads or sets is a Port; forces of controllers are added to all strengths (feedback.py).
Checked in tests/contracts/test_actions.py: direction against autograd, momentum, slopes of laws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.math.elementwise import angle_near, apply_elementwise, partial_derivatives, reciprocal, sqrt
from torchmbd.math.pair import Pair, cat, cross, dot, linear, value
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.forces.laws import Scaled, data_fields
from torchmbd.multibody.forces.parametric_law import ParametricLaw

Law = Callable[[Tensor, Tensor, Tensor], Tensor]
Data = Mapping[str, Any]  # of a design (multibody/equations/data.py)


@dataclass(frozen=True, eq=False)
class Action:
    """All actions of one kind in a system.

    members  for each argument the indices of its vectors, long [n]
    laws     f(s, s', t) of each, or one of all
    """

    members: tuple[Tensor, ...]
    laws: tuple[Law, ...]
    arguments: ClassVar[tuple[str, ...]]

    def direction(self, vectors) -> list:
        """Force of a unit generalized force on each argument [3, n, ...], in ground axes."""
        raise NotImplementedError

    def measure(self, vectors):
        """Coordinate s [n, ...]."""
        return linear(torch.zeros_like, vectors[0][0])

    def state(self, vectors, velocities) -> tuple[Any, Any, list]:
        """s, s' [n, ...] and the direction."""
        direction = self.direction(vectors)
        s = self.measure(vectors)
        if type(self).measure is Action.measure:
            return s, s, direction
        rates = [dot(d, x) for d, x in zip(direction, velocities, strict=True)]
        return s, sum(rates[1:], rates[0]), direction

    def strength(self, s, rate, t, data: Data):
        """Generalized forces f [n, ...]."""
        if len(self.laws) == 1:
            return _force(_of(self.laws[0], data), s, rate, t)
        return cat([_force(_of(law, data), s[i : i + 1], rate[i : i + 1], t) for i, law in enumerate(self.laws)])

    def slopes(self, s: Tensor, rate: Tensor, t: Any, data: Data) -> tuple[Tensor, Tensor]:
        """df/ds and df/ds' [n, ...] of values without tangents."""
        if len(self.laws) == 1:
            return law_slopes(_of(self.laws[0], data), s, rate, value(t))
        parts = [law_slopes(_of(law, data), s[i : i + 1], rate[i : i + 1], value(t)) for i, law in enumerate(self.laws)]
        return torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])


class Length(Action):
    """Distance of two points."""

    arguments = ("point", "point")

    def direction(self, vectors) -> list:
        a, b = vectors
        u = (b - a) * reciprocal(self.measure(vectors))
        return [-u, u]

    def measure(self, vectors):
        a, b = vectors
        return sqrt(dot(b - a, b - a))


class Along(Action):
    """Position of point b from point a along an axis."""

    arguments = ("point", "point", "axis")

    def direction(self, vectors) -> list:
        a, b, u = vectors
        return [-u, u, b - a]

    def measure(self, vectors):
        a, b, u = vectors
        return dot(b - a, u)


class Turn(Action):
    """Angle of the axis x of body b from the axis x of body a, towards y of a."""

    arguments = ("axis", "axis", "axis")

    def direction(self, vectors) -> list:
        x, y, b = vectors
        c, s = dot(x, b), dot(y, b)
        inverse = reciprocal(c * c + s * s)
        c, s = c * inverse, s * inverse
        return [-(s * b), c * b, c * y - s * x]

    def measure(self, vectors):
        x, y, b = vectors
        c, s = dot(x, b), dot(y, b)
        if len(self.laws) == 1:
            return angle_near(s, c, getattr(self.laws[0], "center", 0.0))
        parts = [angle_near(s[i : i + 1], c[i : i + 1], getattr(law, "center", 0.0)) for i, law in enumerate(self.laws)]
        return cat(parts)


class Push(Action):
    """A force along an axis."""

    arguments = ("point", "axis")

    def direction(self, vectors) -> list:
        _, u = vectors
        return [u, linear(torch.zeros_like, u)]


class Twist(Action):
    """A torque about an axis u: with the triad e of the body, sum e_k x (u x e_k) / 2 = u."""

    arguments = ("axis", "axis", "axis", "axis")

    def direction(self, vectors) -> list:
        u, *triad = vectors
        return [linear(torch.zeros_like, u), *(0.5 * cross(u, e) for e in triad)]


class Spin(Action):
    """Spin of body b from body a about an axis u, and a torque on b about it, the opposite one on a; triads e of both.

    As of Twist, on flexible bodies to second order in their elastic rotations.
    """

    arguments = ("axis",) * 7

    def direction(self, vectors) -> list:
        u, *triads = vectors
        on_a, on_b = ([0.5 * cross(u, e) for e in triad] for triad in (triads[:3], triads[3:]))
        return [linear(torch.zeros_like, u), *(-f for f in on_a), *on_b]

    def measure(self, vectors):
        return linear(torch.zeros_like, vectors[0][0])


def _of(law: Law, data: Data) -> Law:
    """The law with the values of the data, if it has design variables."""
    return law.at(data) if isinstance(law, ParametricLaw) else law


def _force(law: Law, s: Any, rate: Any, t: Any) -> Any:
    """The force of a law at tensors or pairs s, rate; where the law states its slopes, without automatic differentiation."""
    if isinstance(law, Port):
        return linear(torch.zeros_like, s)
    if isinstance(law, Scaled):
        return _force(law.law, s, rate, t) * law.factor
    if data_fields(law):
        return law(s, rate, t)  # takes pairs
    if not (hasattr(law, "slopes") and isinstance(s, Pair)):
        return apply_elementwise(law, s, rate, t)
    at = value(s), value(rate), value(t)
    by_s, by_rate = law_slopes(law, *at)
    tangents = by_s * s.tangent + by_rate * rate.tangent
    if isinstance(t, Pair):
        tangents = tangents + partial_derivatives(lambda now: law(*at[:2], now), at[2])[0] * t.tangent
    return Pair.of(law(*at), tangents)


def law_slopes(law: Law, s: Tensor, rate: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """df/ds and df/ds' of values without tangents."""
    if isinstance(law, Scaled):
        by_s, by_rate = law_slopes(law.law, s, rate, t)
        return by_s * law.factor, by_rate * law.factor
    method = getattr(law, "slopes", None)
    if method is not None:
        return method(s, rate, t)
    by_s, by_rate, _ = partial_derivatives(law, s, rate, t)
    return by_s, by_rate


# The order in which actions stand; other kinds come behind, as they occur.
KINDS: tuple[type[Action], ...] = (Length, Along, Turn, Push, Twist, Spin)
