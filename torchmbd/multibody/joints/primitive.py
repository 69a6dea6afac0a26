"""Constraint primitives: the kinds of equations of all joints.

A primitive acts on *vectors attached to bodies*: points (position in ground axes, [m]) and axes (unit vectors).
All primitives of one kind are evaluated together; `members` holds, for each argument, the indices of its vectors.

    kind           equation                                    rows   unit
    Coincide       g_b - g_a = 0                               3      m
    Perpendicular  u_a . v_b = 0                               1      -
    Plane          (g_b - g_a) . u_a = 0                       1      m
    Distance       (|g_b - g_a|^2 - L^2) / (2 L) = 0           1      m
    Angle          cos(th) y_a . x_b - sin(th) x_a . x_b = 0   1      -     th(t): the prescribed angle [rad]
    Travel         (g_b - g_a) . u_a - s = 0                   1      m     s(t): the prescribed travel [m]
    Relation       sum c_i x_i - d = 0                         1      -     angles and travels of joints (relation.py)

The contract of a kind:

    rows                         equations of one primitive
    is_length                    whether these are lengths
    phi(vectors, drive)          [rows, n, ...] on numbers or on time jets: velocities and gamma come from the jets
    forces(vectors, lam, drive)  gradient of sum(lam * phi) by each vector, [3, n, ...] for each argument

    drive(x)                     arguments of the equation out of a prescribed x, number or jet: (cos th, sin th), or (s,)

The argument `drive` of phi and forces has these at the time of evaluation; None without a law. `numbers` holds the constants
of all primitives of the kind. A kind with angles gets their turns behind these: angles of rigid bodies that count full turns
(multibody/equations/turns.py), near which those of its equation are.

No other code is needed for a constraint, not even for compiled steps, which are traced from phi and forces: Phi_q and the
generalized constraint forces are `forces` transformed to the bodies, gamma is the acceleration part of the jet, the design
tangents follow from pairs (math/pair.py).
Source: Nikravesh, Computer-Aided Analysis of Mechanical Systems, chapter 7; eqs. (4)-(6) of the paper.
Checked in tests/contracts/test_primitives.py: `forces` against autograd, jets against differences in time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.math.forward_mode import jvp
from torchmbd.math.jet import Jet, cos, dot, sin
from torchmbd.math.pair import cat, linear

Law = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Primitive:
    """All primitives of one kind in a system.

    members  for each argument the indices of its vectors, long [n]
    data     for each primitive its constants, its law, or None
    constants  numbers in its equation, such as a length: one, or a tuple of so many, for each primitive
    driven   number of arguments that the equation takes from a law, or from numbers that may vary with the design; 0: none
    prescribes  whether these are laws of time, which move bodies
    turns    for each of its `angles` the numbers of its counted turns, long [n]
    """

    members: tuple[Tensor, ...]
    data: tuple = ()
    turns: tuple[Tensor, ...] = ()
    rows: ClassVar[int]
    is_length: ClassVar[bool] = True
    arguments: ClassVar[tuple[str, ...]]
    constants: ClassVar[int] = 0
    driven: ClassVar[int] = 0
    prescribes: ClassVar[bool] = False
    angles: ClassVar[int] = 0
    travels: ClassVar[int] = 0  # of joints, in a relation
    word: ClassVar[str] = ""  # in names of rows; "": the name of the class

    def select(self, numbers: Sequence[int], position: Mapping[int, int] | None = None) -> Primitive:
        """Some of the primitives; position: of vectors in another order."""

        def entries(index: Tensor) -> Tensor:
            return index[torch.tensor(numbers, dtype=torch.long)]

        members = tuple(map(entries, self.members))
        if position is not None:
            members = tuple(torch.tensor([position[i] for i in m.tolist()], dtype=torch.long) for m in members)
        return type(self)(members, tuple(self.data[j] for j in numbers), tuple(map(entries, self.turns)))

    def phi(self, vectors, drive=None):
        """Constraint violations [rows, n, ...] of vectors [3, n, ...], numbers or jets."""
        raise NotImplementedError

    def forces(self, vectors, lam, drive=None) -> list:
        """Gradient of sum(lam * phi) by each argument, [3, n, ...]; lam [rows, n, ...]."""
        raise NotImplementedError

    @classmethod
    def drive(cls, x) -> tuple:
        """Arguments of the equation out of a prescribed x, a number or a jet."""
        raise NotImplementedError

    def sizes(self, size: Any, data: Mapping[str, Any] | None = None) -> Any:
        """Sizes [n, ...] of the equations in mechanisms of a size [...] [m], in their unit (multibody/equations/sizes.py)."""
        n = len(self.members[0])
        if not self.is_length:
            return torch.ones(n, 1, 1, dtype=torch.float64)
        return linear(lambda x: x.expand(n, *x.shape), size)

    @cached_property
    def numbers(self) -> Any:
        """The constants [constants, n, 1, 1]; compiled code takes them as data."""
        rows = torch.tensor(self.data, dtype=torch.float64).reshape(len(self.data), self.constants)
        return rows.T[..., None, None]

    @property
    def varies(self) -> bool:
        """True if a law has design variables."""
        return any(hasattr(law, "numbers") for law in self.data)

    def prescribed(self, times: Tensor, data: Mapping[str, Any] | None = None) -> tuple:
        """`drive` of the laws at times [n], parts [n, laws, pair, lanes]; data: of a design, with design variables of laws."""
        return self.drive(cat([_numbers(law, times, data) for law in self.data], 1))

    def prescribed_jets(self, t: Tensor, data: Mapping[str, Any] | None = None) -> tuple[Jet, ...]:
        """The same at time t [], or of each lane at its own t [lanes], with time derivatives, parts [laws, pair, lanes]."""
        parts = zip(*(_jet(law, t, data).parts for law in self.data), strict=True)
        return self.drive(Jet(*(cat(part) for part in parts)))


class Coincide(Primitive):
    """Two points coincide."""

    rows = 3
    arguments = ("point", "point")

    def phi(self, vectors, drive=None):
        a, b = vectors
        return b - a

    def forces(self, vectors, lam, drive=None):
        return [-lam, lam]


class Perpendicular(Primitive):
    """An axis of one body stays perpendicular to an axis of another."""

    rows = 1
    is_length = False
    arguments = ("axis", "axis")

    def phi(self, vectors, drive=None):
        u, v = vectors
        return row(dot(u, v))

    def forces(self, vectors, lam, drive=None):
        u, v = vectors
        return [lam * v, lam * u]


class Plane(Primitive):
    """A point b stays in the plane through point a with the normal u."""

    rows = 1
    arguments = ("point", "point", "axis")

    def phi(self, vectors, drive=None):
        a, b, u = vectors
        return row(dot(b - a, u))

    def forces(self, vectors, lam, drive=None):
        a, b, u = vectors
        pull = lam * u
        return [-pull, pull, lam * (b - a)]


class Distance(Primitive):
    """Two points keep their distance L > 0: a massless link."""

    rows = 1
    arguments = ("point", "point")
    constants = 1  # L [m]

    def phi(self, vectors, drive=None):
        a, b = vectors
        (length,) = self.numbers
        return row(dot(b - a, b - a) * (0.5 / length) - 0.5 * length)

    def forces(self, vectors, lam, drive=None):
        a, b = vectors
        (length,) = self.numbers
        pull = lam * (b - a) * (1.0 / length)
        return [-pull, pull]


class Angle(Primitive):
    """The axis x of body b stands at a prescribed angle from the axis x of body a, towards y of a."""

    rows = 1
    is_length = False
    arguments = ("axis", "axis", "axis")
    driven = 2
    prescribes = True

    @classmethod
    def drive(cls, x):
        return cos(x), sin(x)

    def phi(self, vectors, drive=None):
        x, y, b = vectors
        c, s = required(drive)
        return row(dot(y, b) * c - dot(x, b) * s)

    def forces(self, vectors, lam, drive=None):
        x, y, b = vectors
        c, s = (lam * part for part in required(drive))
        return [-(s * b), c * b, c * y - s * x]


class Travel(Primitive):
    """Point b has a prescribed distance from the plane through point a with the normal u, along u."""

    rows = 1
    arguments = ("point", "point", "axis")
    driven = 1
    prescribes = True

    @classmethod
    def drive(cls, x):
        return (x,)

    def phi(self, vectors, drive=None):
        a, b, u = vectors
        (s,) = required(drive)
        return row(dot(b - a, u) - s)

    def forces(self, vectors, lam, drive=None):
        a, b, u = vectors
        pull = lam * u
        return [-pull, pull, lam * (b - a)]


def required(drive: tuple | None) -> tuple:
    if drive is None:
        raise TypeError("a driven primitive needs the argument drive")
    return drive


def row(x):
    """Give a scalar equation its row axis."""
    return x.map(row) if isinstance(x, Jet) else x[None]


def _numbers(law: Any, times: Tensor, data: Mapping[str, Any] | None) -> Any:
    """Values [n, 1, pair, lanes] of a law at times [n]."""
    if hasattr(law, "numbers"):
        return law.numbers(times, data).unsqueeze(1)
    return values_at(law, times)[:, None, None, None]


def _jet(law: Any, t: Tensor, data: Mapping[str, Any] | None) -> Jet:
    """A law with its slopes, parts [1, pair, lanes]."""
    if hasattr(law, "numbers"):
        return law.jets(t, data).map(lambda x: x.unsqueeze(0))
    return Jet(*(x.reshape(1, 1, -1) for x in (slopes_at if t.dim() else slopes)(law, t)))


def values_at(law: Law, times: Tensor) -> Tensor:
    """Values of a law at times [n]: by one call if it states its slopes, else by one call for each time."""
    return law(times) if hasattr(law, "slopes") else torch.stack([law(t) for t in times])


def slopes(law: Law, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A law with its first and second derivatives at time t; a law may state them itself by a method of this name."""
    method = getattr(law, "slopes", None)
    if method is not None:
        return method(t)

    def rates(s: Tensor) -> tuple:
        return jvp(law, (s,), (torch.ones_like(s),))

    (x, velocity), (_, acceleration) = jvp(rates, (t,), (torch.ones_like(t),))[:2]
    return x, velocity, acceleration


def slopes_at(law: Law, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same at many times, [n] each."""
    if hasattr(law, "slopes"):
        return slopes(law, times)
    return tuple(torch.stack(x) for x in zip(*(slopes(law, t) for t in times), strict=True))  # pyright: ignore


# The order in which equations stand; other kinds come behind, as they occur.
KINDS: tuple[type[Primitive], ...] = (Coincide, Plane, Distance, Perpendicular, Angle, Travel)
