"""The contract of every constraint primitive: one text of Phi, its gradient written by hand, its time derivatives by jets."""

from __future__ import annotations

from math import cos, sin

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchmbd.math.jet import Jet
from torchmbd.math.pair import Pair
from torchmbd.multibody.joints.point_on_curve import Graph
from torchmbd.multibody.joints.primitive import KINDS, Angle, Primitive
from torchmbd.multibody.joints.relation import RELATIONS, Factors, Relation

COUNT, LANES, TANGENTS = 4, 3, 2
TURNS = torch.tensor([0.4, 13.0, -70.0, 1e3], dtype=torch.float64)[:, None, None]  # angles near which others are
LAWS = tuple(lambda t, k=k: 0.4 * k + torch.sin((1.0 + k) * t) + t * t for k in range(COUNT))


def primitive(kind: type[Primitive]) -> Primitive:
    """Several primitives of a kind, each with its own length or law."""
    members = tuple(torch.arange(COUNT) for _ in kind.arguments)
    data = LAWS if kind.driven else tuple(0.5 + 0.3 * k for k in range(COUNT))
    if kind.constants > 1:
        data = tuple(tuple(0.4 * i - 0.3 * k + 0.1 for i in range(kind.constants)) for k in range(COUNT))
    if issubclass(kind, Relation):
        factors = [tuple(0.7 * i - 0.4 * k for i in range(kind.driven)) for k in range(COUNT)]
        data = tuple(Factors("", x, (None,) * kind.driven, None) for x in factors)
    return kind(members, data)


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def drive_of(kind: type[Primitive], t: Tensor, derivatives: bool = False):
    if not kind.driven:
        return None
    P = primitive(kind)
    turns = tuple(TURNS + k for k in range(kind.angles))
    return (*(P.prescribed_jets(t) if derivatives else (x[0] for x in P.prescribed(t[None]))), *turns)


def numbers(kind: type[Primitive], columns: int = 1) -> list[Tensor]:
    return [random(3, COUNT, columns, LANES, seed=10 + k) for k in range(len(kind.arguments))]


kinds = pytest.mark.parametrize("kind", [*KINDS, Graph, *RELATIONS.values()], ids=lambda kind: kind.__name__)


@kinds
def test_phi_has_the_rows_it_declares(kind):
    t = torch.tensor(0.3, dtype=torch.float64)
    assert primitive(kind).phi(numbers(kind), drive_of(kind, t)).shape == (kind.rows, COUNT, 1, LANES)


@kinds
def test_forces_are_the_gradient_of_phi(kind):
    """A sign or a factor lost in `forces` gives wrong reactions, and a Phi_q that does not belong to Phi."""
    P, t = primitive(kind), torch.tensor(0.3, dtype=torch.float64)
    vectors = [x.requires_grad_() for x in numbers(kind)]
    lam = random(kind.rows, COUNT, 1, LANES, seed=3)
    drive = drive_of(kind, t)
    expected = torch.autograd.grad((lam * P.phi(vectors, drive)).sum(), vectors)
    for force, gradient in zip(P.forces(vectors, lam, drive), expected, strict=True):
        assert_close(force.expand_as(gradient), gradient, rtol=1e-13, atol=1e-13)


@kinds
def test_jets_are_derivatives_in_time(kind):
    """Gamma is the acceleration part: a lost factor 2 of a mixed term, or a lost derivative of the law, shows here."""
    P = primitive(kind)
    curves = [random(4, 3, COUNT, 1, LANES, seed=20 + k) for k in range(len(kind.arguments))]
    t, one = torch.tensor(0.3, dtype=torch.float64), torch.ones((), dtype=torch.float64)

    def along(s: Tensor) -> list[Tensor]:
        return [c[0] + s * (c[1] + s * (c[2] + s * c[3])) for c in curves]

    def phi(s: Tensor) -> Tensor:
        return P.phi(along(s), drive_of(kind, s))

    def rate(f):
        return lambda s: torch.func.jvp(f, (s,), (one,))[1]

    # Time derivatives of the curves in closed form, so that the jets are an independent route.
    velocity = [c[1] + t * (2.0 * c[2] + 3.0 * t * c[3]) for c in curves]
    acceleration = [2.0 * c[2] + 6.0 * t * c[3] for c in curves]
    jets = [Jet(*parts) for parts in zip(along(t), velocity, acceleration, strict=True)]
    result = P.phi(jets, drive_of(kind, t, derivatives=True))
    for part, expected in zip(result.parts, (phi(t), rate(phi)(t), rate(rate(phi))(t)), strict=True):
        assert_close(part, expected, rtol=1e-12, atol=1e-12)


@kinds
def test_design_tangents_of_phi_and_forces(kind):
    P, t = primitive(kind), torch.tensor(0.3, dtype=torch.float64)
    vectors = [Pair(x) for x in numbers(kind, 1 + TANGENTS)]
    lam = Pair(random(kind.rows, COUNT, 1 + TANGENTS, LANES, seed=3))
    drive = drive_of(kind, t)

    def f(*x):
        return torch.cat([P.phi(x[:-1], drive), *P.forces(x[:-1], x[-1], drive)])

    phi, forces = P.phi(vectors, drive), P.forces(vectors, lam, drive)
    both = (*vectors, lam)
    for k in range(TANGENTS):
        moves = tuple(x.tangent[..., k : k + 1, :] for x in both)
        value, slope = torch.func.jvp(f, tuple(x.value for x in both), moves)
        assert_close(torch.cat([phi.value, *(x.value for x in forces)]), value, rtol=1e-13, atol=1e-13)
        tangents = torch.cat([x.tangent[..., k : k + 1, :] for x in (phi, *forces)])
        assert_close(tangents, slope, rtol=1e-13, atol=1e-13)


def test_a_constant_law_beside_one_of_a_high_power():
    """A law that does not depend on time has no derivatives to give, but must not lose those of its neighbor."""
    laws = (lambda t: torch.full_like(t, 0.7), lambda t: t**5)
    c, s = Angle((), laws).prescribed_jets(torch.tensor(0.9, dtype=torch.float64))
    th, rate, bend = 0.9**5, 5 * 0.9**4, 20 * 0.9**3
    expected = {
        "c": ([cos(0.7), cos(th)], [0.0, -sin(th) * rate], [0.0, -sin(th) * bend - cos(th) * rate**2]),
        "s": ([sin(0.7), sin(th)], [0.0, cos(th) * rate], [0.0, cos(th) * bend - sin(th) * rate**2]),
    }
    for jet, name in ((c, "c"), (s, "s")):
        for part, numbers in zip(jet.parts, expected[name], strict=True):
            assert part.flatten().tolist() == pytest.approx(numbers, rel=1e-14)
