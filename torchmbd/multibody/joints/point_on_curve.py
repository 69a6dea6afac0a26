"""Point on a curve: a point of body b slides along a curve of body a, free to turn. Two equations of one primitive.

    (g_b - g_a) . v - p(x) = 0,    x = (g_b - g_a) . u,    p(x) = c_0 + c_1 x + ... + c_5 x^5

g_a, u, v   point and axes of frame a: u along the curve, v the other two, each with a polynomial of its own
g_b         the point of b

The curve is a graph over u, so no coordinate along it is needed, and nothing is searched. A circle is a `Distance` from its
center with a `PointOnPlane`; a curve that turns back has no such equation.
Checked in tests/contracts/test_primitives.py, test_joints.py, tests/multibody/joints/test_point_on_curve.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import reals
from torchmbd.math.jet import dot
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint, other_axes
from torchmbd.multibody.joints.primitive import Primitive, row

_COUNT = 6  # coefficients: a quintic has given places, slopes and curvatures at two ends


class Graph(Primitive):
    """The distance of point b from point a along v is a polynomial of that along u."""

    rows = 1
    arguments = ("point", "point", "axis", "axis")
    constants = _COUNT  # c_k [m^(1-k)]

    def phi(self, vectors, drive=None):
        a, b, u, v = vectors
        x = dot(b - a, u)
        return row(dot(b - a, v) - _polynomial(list(self.numbers), x))

    def forces(self, vectors, lam, drive=None):
        a, b, u, v = vectors
        x = dot(b - a, u)
        slope = _polynomial([float(k) * c for k, c in enumerate(self.numbers)][1:], x) * lam
        pull = lam * v - slope * u
        return [-pull, pull, -(slope * (b - a)), lam * (b - a)]


def _polynomial(coefficients: list, x):
    """Horner's rule, of numbers, pairs or jets x."""
    result = x * coefficients[-1]
    for c in coefficients[-2:0:-1]:
        result = (result + c) * x
    return result + coefficients[0]


class PointOnCurve(Joint):
    """`PointOnCurve(a, b, [0, 0, 2.0])`: the point of b stays on the curve y = 2 x^2, z = 0 of frame a. Two equations.

    first, second  the distances along the two other axes, in the order x, y, z, x: polynomials in the distance along `axis`
                   with the coefficients c_0 [m], c_1 [-], c_2 [1/m], ..., at most six
    axis           the axis of frame a that is the argument of both polynomials
    name           of the joint in reactions and messages; None: made of the kind and the bodies

    >>> bead = mbd.RigidBody("bead", 0.1, (1e-5, 1e-5, 1e-5), position=(0.3, 0.18, 0))
    >>> wire = mbd.PointOnCurve(mbd.Ground().at(), bead.at(), [0.0, 0.0, 2.0])
    >>> mbd.System([bead], [wire]).describe().freedoms
    4
    """

    def __init__(
        self,
        a: Frame,
        b: Frame,
        first: Sequence[float],
        second: Sequence[float] = (0.0,),
        axis: str = "x",
        name: str | None = None,
    ):
        super().__init__(a, b, name)
        self.across, self.axis = other_axes(axis), axis
        self.polynomials = tuple(_coefficients(self.name, key, c) for key, c in (("first", first), ("second", second)))

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        points = attachments.point(self.a), attachments.point(self.b)
        u = attachments.axis(self.a, self.axis)
        for normal, coefficients in zip(self.across, self.polynomials, strict=True):
            yield Equation(Graph, (*points, u, attachments.axis(self.a, normal)), coefficients)


def _coefficients(name: str, key: str, given: Sequence[float]) -> tuple[float, ...]:
    allowed = f"one to {_COUNT} finite coefficients"
    c = reals((name, key), given)
    if c.dim() != 1 or not 1 <= len(c) <= _COUNT or not bool(torch.isfinite(c).all()):
        raise InputError((name, key), given, allowed)
    return (*c.tolist(), *(0.0,) * (_COUNT - len(c)))
