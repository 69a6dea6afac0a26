"""A joint, a force and a law that are written in one file, with nothing said about native code: native and eager agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box
from tests.refused import refused, warned
from torchmbd.math.jet import Jet, dot
from torchmbd.math.pair import linear
from torchmbd.multibody.forces.action import Action
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.joints.joint import Equation, Joint
from torchmbd.multibody.joints.primitive import Primitive

FIRST, SECOND = (1.0, 2.0), (0.8, 1.5)  # semi-axes of the ellipses [m]


class OnEllipse(Primitive):
    """Point b moves on an ellipse about point a: (d . u / p)^2 + (d . v / q)^2 - 1 = 0 with d = g_b - g_a."""

    rows = 1
    arguments = ("point", "point", "axis", "axis")
    constants = 2  # p, q [m]

    def phi(self, vectors, drive=None):
        (a, b, u, v), (p, q) = vectors, self.numbers
        x, y = dot(b - a, u) * (1.0 / p), dot(b - a, v) * (1.0 / q)
        distance = x * x + y * y - 1.0
        return distance.map(lambda z: z[None]) if isinstance(distance, Jet) else distance[None]

    def forces(self, vectors, lam, drive=None):
        (a, b, u, v), (p, q) = vectors, self.numbers
        x, y = dot(b - a, u) * (2.0 / (p * p)), dot(b - a, v) * (2.0 / (q * q))
        pull = lam * (u * x + v * y)
        return [-pull, pull, lam * x * (b - a), lam * y * (b - a)]


class Ellipse(Joint):
    """The point of b stays on an elliptic cylinder of frame a with the semi-axes `size` along its x and y."""

    def __init__(self, a, b, size, name=None):
        super().__init__(a, b, name)
        self.size = size

    def equations(self, attachments):
        points = attachments.point(self.a), attachments.point(self.b)
        axes = attachments.axis(self.a, "x"), attachments.axis(self.a, "y")
        yield Equation(OnEllipse, (*points, *axes), self.size)


class Square(Action):
    """Half the square of the distance of two points."""

    arguments = ("point", "point")

    def direction(self, vectors):
        a, b = vectors
        return [a - b, b - a]

    def measure(self, vectors):
        a, b = vectors
        return 0.5 * dot(b - a, b - a)


@dataclass(frozen=True)
class Cubic:
    """f = -k s - e s^3 - c s'; both stiffnesses are data of compiled code, the damping is compiled."""

    k: float
    e: float
    c: float = 0.0
    data_fields: ClassVar[tuple[str, ...]] = ("k", "e")

    def __call__(self, s, rate, t):
        return -self.k * s - self.e * (s * s * s) - self.c * rate

    def slopes(self, s, rate, t):
        return -self.k - 3.0 * self.e * s * s, linear(torch.zeros_like, s) - self.c


class Attraction(ForceElement):
    """Two points attract each other by a law of half the square of their distance."""

    def __init__(self, a, b, law, name):
        super().__init__((a, b), name)
        self.law = law

    def actions(self, attachments):
        a, b = self.frames
        yield Applied(Square, (attachments.point(a), attachments.point(b)), self.law)


def build() -> mbd.System:
    ground = mbd.Ground()
    first = mbd.RigidBody("first", mbd.variable(1.0), (0.1, 0.1, 0.1), position=(FIRST[0], 0, 0), velocity=(0, 1.0, 0))
    second = box("second", position=(0.0, SECOND[1], 0.0))
    joints = [
        Ellipse(ground.at(), first.at(), FIRST, name="large"),
        Ellipse(ground.at(), second.at(), SECOND, name="small"),
        mbd.Planar(ground.at(), first.at(), normal="z", name="plane"),
        mbd.Planar(ground.at(), second.at(), normal="z", name="other plane"),
    ]
    forces = [
        Attraction(first.at(0.1, 0.0, 0.0), second.at(), Cubic(3.0, 0.5, 0.1), "near"),
        Attraction(ground.at(0.3, 0.0, 0.0), second.at(), Cubic(1.0, -0.1, 0.1), "middle"),
        mbd.SpringDamper(ground.at(), first.at(), law=Cubic(2.0, 0.2, 0.1), name="spring"),
        mbd.Force(second.at(), (0.0, 0.3, 0.0), name="push"),
    ]
    return mbd.System([first, second], joints, forces)


def run(backend: str, gradients: str = "reverse", **options):
    system = build()
    motion = mbd.simulate(system, 0.5, steps=100, backend=backend, gradients=gradients, **options).require_ok()
    path = mbd.Max(mbd.Position("second", "x")) + mbd.Integral(mbd.Velocity("first", "y"))
    return motion, *path.value_and_gradient(motion)


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["reverse", "forward"])
def test_native_and_eager_agree(gradients):
    (native, value, gradient), (eager, other, slope) = run("native", gradients), run("eager", gradients)
    for name, rounding in (("q", 1e-12), ("v", 1e-10), ("a", 1e-6), ("lam", 1e-6)):  # of q, over h and over h^2
        assert_close(getattr(native, name), getattr(eager, name), rtol=0, atol=rounding)
    assert_close(value, other, rtol=1e-10, atol=1e-12)
    assert_close(gradient, slope, rtol=1e-8, atol=1e-10)
    assert float(gradient.abs().min()) > 1e-4


@pytest.mark.thorough
def test_native_code_of_the_right_hand_side_agrees():
    (native, value, _), (eager, other, _) = (run(backend, "forward", method="rk4") for backend in ("native", "eager"))
    assert_close(native.q, eager.q, rtol=1e-9, atol=1e-9)
    assert_close(value, other, rtol=1e-10, atol=1e-12)


@pytest.mark.thorough
def test_the_points_stay_on_their_ellipses():
    motion, *_ = run("eager")
    for name, (p, q) in (("first", FIRST), ("second", SECOND)):
        x, y, z = motion.body(name).r[0].T
        assert_close((x / p) ** 2 + (y / q) ** 2, torch.ones_like(x), rtol=0, atol=1e-9)
        assert float(z.abs().max()) < 1e-12
        assert float((x - x[0]).abs().max()) > 0.01


@pytest.mark.thorough
def test_a_law_that_reads_what_has_changed_is_compiled_again(monkeypatch):
    """Native code follows a global that a law of a class reads."""
    values = {}
    for k in (1.0, 300.0):
        monkeypatch.setattr(Cubic, "factor", k, raising=False)
        for backend in ("native", "eager"):
            ground, bob = mbd.Ground(), box("bob", position=(1.0, 0.0, 0.0))
            spring = mbd.SpringDamper(ground.at(), bob.at(), law=Factored(3.0, 0.5, 0.1), name="spring")
            system = mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])
            motion = mbd.simulate(system, 0.1, steps=40, backend=backend, gradients="none").require_ok()
            values[k, backend] = motion.body("bob").r[0, -1, 0]
    for k in (1.0, 300.0):
        assert_close(values[k, "native"], values[k, "eager"], rtol=1e-10, atol=0)
    assert abs(values[1.0, "eager"] - values[300.0, "eager"]) > 1e-3


@dataclass(frozen=True)
class Factored(Cubic):
    """A cubic law times an attribute of the class."""

    def __call__(self, s, rate, t):
        return Cubic.factor * Cubic.__call__(self, s, rate, t)  # pyright: ignore[reportAttributeAccessIssue]

    def slopes(self, s, rate, t):
        return tuple(Cubic.factor * x for x in Cubic.slopes(self, s, rate, t))  # pyright: ignore


@dataclass(frozen=True)
class NoSlopes:
    k: float
    data_fields: ClassVar[Any] = ("k",)

    def __call__(self, s, rate, t):
        return -self.k * s


@dataclass(frozen=True)
class Misspelled(Cubic):
    data_fields: ClassVar[Any] = ("k", "stiffness")


@dataclass(frozen=True)
class Listed(Cubic):
    powers: Any = None


@dataclass(frozen=True)
class Sine(Cubic):
    def __call__(self, s, rate, t):
        return -self.k * torch.sin(s)


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (NoSlopes(1.0), "NoSlopes.*slopes"),
        (Misspelled(1.0, 0.5), "Misspelled.*'stiffness'.*must "),
        (Listed(1.0, 0.5, powers=[1.0]), "Listed.*a tuple for a list"),
        (Sine(1.0, 0.5), "Sine.*does not take pairs.*must "),
    ],
)
def test_a_law_that_breaks_the_rule_of_data_fields_is_refused(law, words):
    with pytest.raises(mbd.InputError, match=f"law of 'spring'.*{words}"):
        mbd.SpringDamper(mbd.Ground().at(), box("bob").at(), law=law, name="spring")


@pytest.mark.parametrize("size", [(1.0,), 1.0, (1.0, None), (1.0, 2.0, 3.0), (float("nan"), 1.0)])
def test_constants_of_a_primitive_are_counted(size):
    ground, bob = mbd.Ground(), box("bob")
    with refused("large.constants"):
        mbd.System([bob], [Ellipse(ground.at(), bob.at(), size, name="large")])


def test_a_variable_as_a_constant_is_refused():
    ground, bob = mbd.Ground(), box("bob")
    with refused("a constant of 'large' (onellipse)"):
        mbd.System([bob], [Ellipse(ground.at(), bob.at(), (mbd.variable(1.0), 2.0), name="large")])


@dataclass(frozen=True)
class Switched(Cubic):
    """A cubic law that acts from t = 0.05 s on."""

    def __call__(self, s, rate, t):
        return Cubic.__call__(self, s, rate, t) * (1.0 if float(t.flatten()[0]) > 0.05 else 0.0)


@pytest.mark.thorough
def test_a_law_with_data_fields_that_jumps_in_time_is_told():
    ground, bob = mbd.Ground(), box("bob", position=(1.0, 0.0, 0.0))
    spring = mbd.SpringDamper(ground.at(), bob.at(), law=Switched(3.0, 0.5), name="spring")
    system = mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])
    with warned("'spring'", "jumps"):
        mbd.simulate(system, 0.1, steps=40, backend="eager", gradients="none")
