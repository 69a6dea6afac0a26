"""Time jets: a quantity with its first and second time derivative, or with the first alone.

    x -> (x, x', x'')        <u, v>'' = <u'', v> + 2 <u', v'> + <u, v''>

A constraint Phi of jets of the attached vectors has Phi, Phi' and Phi'', so each constraint has one function; with
accelerations a in the jets, Phi'' = Phi_q a - gamma. Components are tensors or pairs. A sum or product with a jet without
acceleration has none.
Checked in tests/math/test_pair.py and, through every joint, in tests/contracts/test_joints.py.
"""

from __future__ import annotations

from torchmbd.math import elementwise, pair


class Jet:
    """A number with its velocity and acceleration; acceleration None: a jet of first order."""

    __slots__ = ("acceleration", "value", "velocity")

    def __init__(self, value, velocity, acceleration=None):
        self.value = value
        self.velocity = velocity
        self.acceleration = acceleration

    @property
    def parts(self) -> tuple:
        """Value, velocity and, in a jet of second order, acceleration."""
        both = self.value, self.velocity
        return both if self.acceleration is None else (*both, self.acceleration)

    def __add__(self, other) -> Jet:
        if not isinstance(other, Jet):  # constant in time
            return Jet(self.value + other, self.velocity, self.acceleration)
        return Jet(*(a + b for a, b in zip(self.parts, other.parts, strict=False)))

    def __sub__(self, other) -> Jet:
        if not isinstance(other, Jet):  # constant in time
            return Jet(self.value - other, self.velocity, self.acceleration)
        return Jet(*(a - b for a, b in zip(self.parts, other.parts, strict=False)))

    def __mul__(self, other) -> Jet:
        if not isinstance(other, Jet):  # constant in time
            return self.map(lambda x: x * other)
        return _product(lambda a, b: a * b, self, other)

    def map(self, f) -> Jet:
        """Apply a map that is linear and constant in time."""
        return Jet(*(f(x) for x in self.parts))


def _product(f, a: Jet, b: Jet) -> Jet:
    both = f(a.value, b.value), f(a.velocity, b.value) + f(a.value, b.velocity)
    if a.acceleration is None or b.acceleration is None:
        return Jet(*both)
    return Jet(*both, f(a.acceleration, b.value) + 2.0 * f(a.velocity, b.velocity) + f(a.value, b.acceleration))


def dot(a, b):
    """Scalar product over the first axis, of numbers or of jets."""
    if isinstance(a, Jet):
        return _product(pair.dot, a, b)
    return pair.dot(a, b)


def sin(angle):
    """Sine of a number or of a jet."""
    if not isinstance(angle, Jet):
        return elementwise.sin(angle)
    s, c = elementwise.sin(angle.value), elementwise.cos(angle.value)
    if angle.acceleration is None:
        return Jet(s, c * angle.velocity)
    return Jet(s, c * angle.velocity, c * angle.acceleration - s * (angle.velocity * angle.velocity))


def cos(angle):
    """Cosine of a number or of a jet."""
    if not isinstance(angle, Jet):
        return elementwise.cos(angle)
    s, c = elementwise.sin(angle.value), elementwise.cos(angle.value)
    if angle.acceleration is None:
        return Jet(c, -(s * angle.velocity))
    return Jet(c, -(s * angle.velocity), -(s * angle.acceleration) - c * (angle.velocity * angle.velocity))


def angle_near(s, c, center):
    """The angle of the point (c, s), numbers or jets, within half a turn of a center that is constant in time."""
    if not isinstance(s, Jet):
        return elementwise.angle_near(s, c, center)
    inverse = elementwise.reciprocal(c.value * c.value + s.value * s.value)
    rate = (c.value * s.velocity - s.value * c.velocity) * inverse
    if s.acceleration is None or c.acceleration is None:
        return Jet(elementwise.angle_near(s.value, c.value, center), rate)
    stretch = (c.value * c.velocity + s.value * s.velocity) * inverse
    bend = (c.value * s.acceleration - s.value * c.acceleration) * inverse
    return Jet(elementwise.angle_near(s.value, c.value, center), rate, bend - 2.0 * (rate * stretch))


__all__ = ["Jet", "angle_near", "cos", "dot", "sin"]
