"""The contract of every joint, between every kind of body, in general positions.

A joint is checked against what it *means*: the relative motions that it allows, written down here independently of its
equations. Then its equations against their own derivatives: Phi_q, Phi_t, gamma, and the constraint forces.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, cross_matrix, plate, tensor, turned
from tests.refused import refused
from torchmbd.math.rotation import euler_parameters
from torchmbd.multibody.equations import equations
from torchmbd.multibody.joints import JOINTS

LENGTH = 0.4
START = LENGTH * tensor(0.48, -0.6, 0.64)  # from point a to point b of a distance joint, in the axes of frame a


def law(t: Tensor) -> Tensor:
    return torch.sin(2.0 * t) + 0.5 * t * t


def unit(axis: str) -> Tensor:
    return torch.eye(3, dtype=torch.float64)["xyz".index(axis)]


def about(axis: str, angle: float) -> Tensor:
    return turned(*(angle * unit(axis)).tolist())


def across(axis: str, x: Tensor) -> Tensor:
    return x - x["xyz".index(axis)] * unit(axis)


LEAD = 0.07  # travel of a screw for a rotation by 1 rad [m]


BENT = {
    "first": (0.0, 0.4, 0.3),
    "second": (0.0, -0.3, 0.0, 0.2),
}  # curves over an axis, through frame a


def along(axis: str, x: Tensor) -> Tensor:
    k = "xyz".index(axis)
    places = [sum(c * x**i for i, c in enumerate(coefficients)) for coefficients in BENT.values()]
    return x * unit(axis) + places[0] * unit("xyz"[(k + 1) % 3]) + places[1] * unit("xyz"[(k + 2) % 3])


def ahead(axis: str, x: Tensor) -> Tensor:
    return across(axis, x) + float(law(tensor(0.7))) * unit(axis)


@dataclass(frozen=True, eq=False)
class Case:
    """A joint, its equations, and the motions of b that it allows: 3 numbers -> (translation, rotation) in axes of frame a."""

    kind: str
    rows: int
    allowed: Callable[[Tensor], tuple[Tensor, Tensor]]
    given: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return "-".join([self.kind, *(x for x in self.given.values() if isinstance(x, str))])


ZERO, ONE = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
CASES = [
    Case("fixed", 6, lambda x: (ZERO, ONE)),
    Case("spherical", 3, lambda x: (ZERO, turned(*x.tolist()))),
    Case(
        "distancejoint",
        1,
        lambda x: (turned(*x.tolist()) @ START - START, turned(*x.flip(0).tolist())),
        {"length": LENGTH},
    ),
]
for axis in "xyz":
    e, given = unit(axis), {"axis": axis}
    CASES += [
        Case("revolute", 5, lambda x, k=axis: (ZERO, about(k, float(x[0]))), given),
        Case("prismatic", 5, lambda x, e=e: (x[0] * e, ONE), given),
        Case("cylindrical", 4, lambda x, k=axis, e=e: (x[0] * e, about(k, float(x[1]))), given),
        Case("pointonplane", 1, lambda x, k=axis: (across(k, x), turned(*x.flip(0).tolist())), {"normal": axis}),
        Case("pointoncurve", 2, lambda x, k=axis: (along(k, x[0]), turned(*x.flip(0).tolist())), given | BENT),
        Case("planar", 3, lambda x, k=axis: (across(k, x), about(k, float(x[2]))), {"normal": axis}),
        Case("jointcoupling", 5, lambda x, k=axis, e=e: (LEAD * x[0] * e, about(k, float(x[0]))), given),
        Case("drive", 1, lambda x, k=axis: (x, about(k, float(law(tensor(0.7))))), given | {"angle": law}),
        Case("drive", 1, lambda x, k=axis: (ahead(k, x), turned(*x.tolist())), given | {"position": law}),
    ]
for first, second in ("xy", "yz", "zx", "yx", "zy", "xz"):
    cross = lambda x, i=first, j=second: (ZERO, about(i, float(x[0])) @ about(j, float(x[1])))  # noqa: E731
    CASES.append(Case("universal", 4, cross, {"axes": first + second}))

PAIRS = ["rigid-rigid", "rigid-flexible", "flexible-rigid", "flexible-flexible", "ground-rigid", "flexible-ground"]
AT_TIME = 0.7  # of the drive's law


@dataclass
class Joined:
    """A system of one joint, with the frames of its two sides."""

    system: mbd.System
    frames: tuple[mbd.Frame, mbd.Frame]
    data: dict[str, Tensor]

    def violation(self, q: Tensor, t: float | Tensor) -> Tensor:
        T = self.system.topology
        at = equations.placement(T, self.data, q, T.prescribed(torch.as_tensor(t, dtype=torch.float64)))
        return equations.constraints(T, at)


def body(kind: str, name: str) -> tuple[Any, mbd.Frame]:
    """A body of a kind, and a frame off its origin; the first body's with axes of its own, which are those of the joint."""
    own = name == "a"
    if kind == "ground":
        ground = mbd.Ground()
        return ground, ground.at(0.2, -0.1, 0.3, axes=turned(0.3, 1.0, -0.5) if own else None)
    if kind == "rigid":
        result = box(name)
        return result, result.at(0.1, -0.05, 0.2, axes=turned(-0.8, 0.4, 0.6) if own else None)
    result = plate(name)
    return result, result.at("left" if own else "corner_right_top", axes=turned(0.5, 0.7, -0.2) if own else None)


def joints_of(case: Case, a: mbd.Frame, b: mbd.Frame) -> list[Any]:
    """The joint; a coupling makes a screw of a cylindrical joint."""
    if case.kind != "jointcoupling":
        return [JOINTS[case.kind](a, b, **case.given, name="joint")]
    guide = mbd.Cylindrical(a, b, **case.given, name="joint")
    return [guide, mbd.JointCoupling([guide.travel, guide.angle], [1.0, -LEAD], name="joint")]


@functools.cache
def joined(case: Case, pair: str) -> Joined:
    """Place both bodies so that the joint is closed, and join them."""
    (a, frame_a), (b, frame_b) = (body(kind, name) for kind, name in zip(pair.split("-"), "ab", strict=True))
    pose_a, pose_b = (tensor(0.3, 0.5, -0.2), turned(0.9, -0.3, 0.4)), (ZERO, turned(-0.2, 1.1, 0.6))
    if isinstance(a, mbd.Ground):
        pose_a = (ZERO, ONE)
    if isinstance(b, mbd.Ground):
        pose_b = (ZERO, ONE)
    gap = START if case.kind == "distancejoint" else ZERO
    if isinstance(b, mbd.Ground):
        r = frame_b.point - pose_a[1] @ (frame_a.point + frame_a.axes @ gap)
        pose_a = (r, pose_a[1])
    else:
        r = pose_a[0] + pose_a[1] @ (frame_a.point + frame_a.axes @ gap) - pose_b[1] @ frame_b.point
        pose_b = (r, pose_b[1])
    bodies = []
    for x, (r, A) in ((a, pose_a), (b, pose_b)):
        if not isinstance(x, mbd.Ground):
            x.position, x.axes = r, A
            bodies.append(x)
    system = mbd.System(bodies, joints_of(case, frame_a, frame_b))
    data = {name: x.detach() for name, x in system().dynamics.data.items()}
    return Joined(system, (frame_a, frame_b), data)


def coordinates(joined: Joined, poses: dict[str, tuple[Tensor, Tensor]]) -> Tensor:
    """q [n_q, 1, 1] of origins and rotations of the bodies, undeformed."""
    T = joined.system.topology
    r = torch.stack([poses[name][0] for name in T.names], 1)
    p = torch.stack([euler_parameters(poses[name][1]) for name in T.names], 1)
    rest = torch.zeros(T.n_q - 7 * T.bodies, dtype=torch.float64)  # modes, and angles that count turns
    return torch.cat([r.flatten(), p.flatten(), rest])[:, None, None]


def moved(joined: Joined, u: Tensor, R: Tensor) -> Tensor:
    """Coordinates after the relative motion (u, R) of b in the axes of frame a, and some motion of both."""
    a, b = joined.frames
    at_a, at_b = a.body.position + a.body.axes @ a.point, b.body.position + b.body.axes @ b.point
    axes = a.body.axes @ a.axes
    gap, twist = axes.T @ (at_b - at_a), axes.T @ b.body.axes
    if isinstance(b.body, mbd.Ground):
        axes_a = (R @ twist).T
        body_a = axes_a @ a.axes.T
        origin = at_b - axes_a @ (gap + u) - body_a @ a.point
        return coordinates(joined, {"a": (origin, body_a)})
    shift, spin = (ZERO, ONE) if isinstance(a.body, mbd.Ground) else (tensor(0.4, -0.3, 0.2), turned(-0.6, 0.8, 1.0))
    axes, at_a = spin @ axes, spin @ at_a + shift
    body_b = axes @ R @ twist
    pose_b = (at_a + axes @ (gap + u) - body_b @ b.point, body_b)
    pose_a = (spin @ a.body.position + shift, spin @ a.body.axes)
    return coordinates(joined, {"a": pose_a, "b": pose_b})


def contract() -> list:
    """Every case between flexible bodies, and the first of each kind between all kinds of bodies: axes are of frames."""
    kinds: set[str] = set()
    chosen = []
    for case in CASES:
        pairs = ["flexible-flexible"] if case.kind in kinds else PAIRS
        kinds.add(case.kind)
        chosen += [pytest.param(case, pair, id=f"{case}-{pair}") for pair in pairs]
    return chosen


between = pytest.mark.parametrize(("case", "pair"), contract())


def test_every_joint_is_here():
    assert {case.kind for case in CASES} == set(JOINTS)


@between
def test_equations_are_as_many_as_the_joint_takes_freedoms(case, pair):
    system = joined(case, pair).system
    T, data = system.topology, joined(case, pair).data
    q = system.dynamics().initial.q[:, None, None]
    at = equations.placement(T, data, q, T.prescribed(torch.zeros((), dtype=torch.float64)))
    Phi_q = system.dynamics().saddle.jacobian(data, at)[0]
    assert Phi_q.shape == (case.rows, T.n_v)
    assert int(torch.linalg.matrix_rank(Phi_q)) == case.rows
    assert len(T.row_names) == case.rows
    assert all(name.startswith("joint: ") for name in T.row_names)


@between
def test_allowed_motions_satisfy_the_joint_and_others_do_not(case, pair):
    for x in (tensor(0.3, -0.5, 0.2), tensor(-1.1, 0.7, 0.9)):
        q = moved(joined(case, pair), *case.allowed(x))
        assert float(joined(case, pair).violation(q, AT_TIME).abs().max()) < 1e-14
    u, R = tensor(0.05, 0.11, -0.07), turned(0.3, -0.6, 0.5)
    assert float(joined(case, pair).violation(moved(joined(case, pair), u, R), AT_TIME).abs().max()) > 1e-3


class Curve:
    """A smooth motion of all coordinates through a general state, with its rates; rotations as normalized polynomials."""

    def __init__(self, T: Any):
        make = torch.Generator().manual_seed(T.n_q)
        self.T, self.c = T, torch.randn(3, T.n_q, 1, 1, generator=make, dtype=torch.float64)
        self.c[:, 7 * T.bodies :] *= 1e-2

    def q(self, t: Tensor) -> Tensor:
        x = self.c[0] + t * (self.c[1] + t * self.c[2])
        r, p, w = x.split([3 * self.T.bodies, 4 * self.T.bodies, self.T.n_q - 7 * self.T.bodies])
        p = p.unflatten(0, (4, -1))
        return torch.cat([r, (p / (p * p).sum(0).sqrt()).flatten(0, 1), w])

    def v(self, t: Tensor) -> Tensor:
        """omega = 2 (e0 e' - e0' e - e x e') in body axes."""
        q, rate = torch.func.jvp(self.q, (t,), (torch.ones_like(t),))
        n = self.T.bodies
        p, pd = q[3 * n : 7 * n].unflatten(0, (4, n)), rate[3 * n : 7 * n].unflatten(0, (4, n))
        omega = 2.0 * (p[:1] * pd[1:] - pd[:1] * p[1:] - torch.linalg.cross(p[1:], pd[1:], dim=0))
        return torch.cat([rate[: 3 * n], omega.flatten(0, 1), rate[7 * n : 7 * n + self.T.modes * self.T.flexible]])


@between
def test_equations_against_their_derivatives_in_time(case, pair):
    system, data = joined(case, pair).system, joined(case, pair).data
    T, t, one = system.topology, torch.tensor(AT_TIME, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    curve = Curve(T)
    v, a = torch.func.jvp(curve.v, (t,), (one,))
    q = curve.q(t)

    def phi(s: Tensor) -> Tensor:
        return joined(case, pair).violation(curve.q(s), s)

    def rate(s: Tensor) -> Tensor:
        return torch.func.jvp(phi, (s,), (one,))[1]

    at = equations.placement(T, data, q, T.prescribed(t))
    jets = equations.constraint_jets(T, at, data, v, a, t)
    for part, expected in zip(jets.parts, (phi(t), rate(t), torch.func.jvp(rate, (t,), (one,))[1]), strict=True):
        assert_close(part, expected, rtol=1e-11, atol=1e-11)

    Phi_q = system.dynamics().saddle.jacobian(data, at)[0]
    _, Phi_t = torch.func.jvp(lambda s: joined(case, pair).violation(q, s), (t,), (one,))
    assert_close(Phi_q @ v[:, 0, 0] + Phi_t[:, 0, 0], jets.velocity[:, 0, 0], rtol=1e-12, atol=1e-12)

    lam = torch.randn(T.rows, 1, 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    reaction = torch.cat([x.flatten() for x in equations.constraint_forces(T, data, at, lam)])
    assert_close(reaction, Phi_q.T @ lam[:, 0, 0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("pair", ["rigid-flexible", "flexible-flexible"])
def test_axes_bend_with_their_node(pair):
    """The axis of a frame on a flexible body turns with the rotation of its node; the point moves with the node."""
    case = next(case for case in CASES if case.kind == "revolute")
    system, data = joined(case, pair).system, joined(case, pair).data
    T = system.topology
    q = coordinates(joined(case, pair), dict.fromkeys(T.names, (ZERO, ONE)))
    w = tensor(2e-3, -1e-3, 3e-3)
    for i in range(T.flexible):
        q[T.w_slice(i), 0, 0] = w * (1.0 + i)
    at = equations.placement(T, data, q, T.prescribed(torch.zeros((), dtype=torch.float64)))
    for k, attached in enumerate(T.attached[: T.attached_flexible]):
        flexible = T.names.index(attached.body.name)
        moves = attached.body.structure()["psi"].detach()[attached.interpolation.nodes[0]] @ (w * (1.0 + flexible))
        change = moves[:3] if attached.is_point else cross_matrix(moves[3:]) @ attached.vector
        assert_close(at.g[:, k, 0, 0], attached.vector + change, rtol=0, atol=1e-15)
    assert T.attached_flexible >= 2


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "cylindrical", "planar", "drive"])
def test_axes_that_contradict_are_refused(kind):
    """Both frames have axes of their own; at the given positions they must agree along the axis of the joint."""
    ground, a = mbd.Ground(), box("a", axes=turned(0.2, -0.4, 0.3))
    given = {"normal": "y"} if kind == "planar" else {"axis": "y"} | ({"speed": 1.0} if kind == "drive" else {})
    frame = ground.at(axes=turned(0.5, 0.1, 0.7))
    agree = a.axes.T @ frame.axes @ turned(0.0, 1.3, 0.0)  # turned about the common axis: still agrees
    JOINTS[kind](frame, a.at(axes=agree), **given)
    JOINTS[kind](frame, a.at(), **given)
    with refused("odd.axes"):
        JOINTS[kind](frame, a.at(axes=turned(1.0, 0.0, 0.0)), name="odd", **given)
