"""The contract of every action and of every force element, in general positions.

Direction against autograd of the coordinate; power of the generalized forces against f s' from differences in time of
the same coordinate; momentum of elements between two bodies; the iteration matrix against differences of the residual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import CARBON, box, laminate, plate, random_state, tensor, turned
from torchmbd.math.elementwise import partial_derivatives
from torchmbd.math.pair import Pair
from torchmbd.multibody.equations import equations
from torchmbd.multibody.forces import FORCES, Gap, Pieces, Spring, Table
from torchmbd.multibody.forces.action import KINDS, Action
from torchmbd.multibody.saddle.blocks import Slopes

COUNT, LANES, TANGENTS = 3, 2, 2


def law(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """Nothing special: nonlinear in everything."""
    return torch.sin(3.0 * s + 0.2) - 0.4 * rate * rate + 0.3 * rate * s + torch.cos(t)


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def action(kind: type[Action]) -> Action:
    return kind(tuple(torch.arange(COUNT) for _ in kind.arguments), (law,) * COUNT)


def numbers(kind: type[Action], seed: int, columns: int = 1) -> list[Tensor]:
    return [random(3, COUNT, columns, LANES, seed=seed + k) for k in range(len(kind.arguments))]


kinds = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


@kinds
def test_direction_is_the_gradient_of_the_coordinate(kind):
    A, vectors = action(kind), [x.requires_grad_() for x in numbers(kind, 10)]
    s = A.measure(vectors)
    if not s.requires_grad:
        pytest.skip("a load without coordinate")
    expected = torch.autograd.grad(s.sum(), vectors)
    for d, gradient in zip(A.direction(vectors), expected, strict=True):
        assert_close(d.expand_as(gradient), gradient, rtol=1e-12, atol=1e-12)


@kinds
def test_pairs_carry_the_tangents(kind):
    A, t = action(kind), tensor(0.4)[0]
    full, rates = numbers(kind, 20, 1 + TANGENTS), numbers(kind, 30, 1 + TANGENTS)

    def forces(vectors, velocities):
        s, rate, direction = A.state(vectors, velocities)
        return [A.strength(s, rate, t, {}) * d for d in direction]

    result = forces([Pair(x) for x in full], [Pair(x) for x in rates])
    for k in range(TANGENTS):
        values = tuple([x[..., :1, :] for x in group] for group in (full, rates))
        moving = tuple([x[..., k + 1 : k + 2, :] for x in group] for group in (full, rates))
        expected, slope = torch.func.jvp(forces, values, moving)
        for f, value, tangent in zip(result, expected, slope, strict=True):
            carried = isinstance(f, Pair)
            number = f.value if carried else f
            assert_close(number, value.expand_as(number), rtol=1e-12, atol=1e-12)
            found_tangent = f.tangent[..., k : k + 1, :] if carried else torch.zeros_like(number)
            assert_close(found_tangent, tangent.expand_as(number), rtol=1e-11, atol=1e-11)


GROUND = mbd.Ground()


def controller(a: mbd.Frame, b: mbd.Frame) -> mbd.Controller:
    """A network of everything that two bodies without joints have."""
    S = mbd.signals
    inputs = [S.PointPosition(a), S.PointVelocity(b), S.Time(), S.PointVelocity(a)]
    outputs = [S.TorqueOn(a, b, "y"), S.ForceOn(b, "x", axes="frame"), S.TorqueOn(GROUND.at(), a, "x")]
    with torch.random.fork_rng():
        torch.manual_seed(4)
        layers = torch.nn.Linear(10, 3), torch.nn.Tanh(), torch.nn.Linear(3, 3)
    return mbd.Controller(torch.nn.Sequential(*layers).double(), inputs, outputs)


ELEMENTS: dict[str, Callable] = {
    "axialspringdamper": partial(mbd.AxialSpringDamper, axis="y", law=law),
    "beamelement": lambda a, b: mbd.BeamElement(
        a, b, torch.nn.Parameter(torch.diag(tensor(3.0, 5.0, 7.0, 0.3, 0.2, 0.5))), damping=0.1
    ),
    "axialstop": partial(mbd.AxialStop, axis="y", lower=10.0, upper=20.0, stiffness=3.0, damping=0.2, exponent=1.5),
    "bushing": partial(
        mbd.Bushing, stiffness=(3.0, 5.0, 7.0), damping=0.4, turning_stiffness=(0.3, 0.2, 0.5), turning_damping=0.1
    ),
    "planecontact": lambda a, b: mbd.PlaneContact(
        a.body.at(0.1, 4.0, -0.1, axes=a.axes),
        b,
        "y",
        stiffness=3.0,
        exponent=1.2,
        damping=0.02,
        friction=0.4,
        speed=2.0,
    ),
    "rotationalstop": partial(mbd.RotationalStop, axis="y", upper=-1.5, stiffness=3.0, damping=0.02, exponent=1.5),
    "rotationalspringdamper": partial(mbd.RotationalSpringDamper, axis="y", law=law),
    "springdamper": partial(mbd.SpringDamper, law=law),
    "pressure": lambda a, b: mbd.Pressure(b.body, 5.0),
    "force": lambda a, b: mbd.Force(b, (1.0, -2.0, 0.5), axes="frame"),
    "temperature": lambda a, b: mbd.Temperature(b.body, 20.0, gradient=lambda t: 300.0 * t),
    "torque": lambda a, b: mbd.Torque(b, lambda t: torch.stack([t.cos(), t, 1.0 - t])),
    "controller": lambda a, b: controller(a, b),
}
BETWEEN = [n for n in ELEMENTS if n not in ("controller", "force", "pressure", "temperature", "torque")]
between = pytest.mark.parametrize("name", BETWEEN)
along = pytest.mark.parametrize("name", [n for n in BETWEEN if n != "beamelement"])  # that one has no coordinate
each = pytest.mark.parametrize("name", list(ELEMENTS))


def test_every_element_is_here():
    assert set(ELEMENTS) == set(FORCES)


def system_of(name: str) -> mbd.System:
    arm = box("arm", axes=turned(0.4, -0.7, 0.3), position=(0.1, 0.0, 0.2))
    make, place = (box, (0.2, 0.1, 0.0)) if name == "beamelement" else (plate, ("right",))  # rigid bodies only
    warm = {"made_of": laminate(ply=CARBON | {"alpha1": -0.3e-6, "alpha2": 28e-6})} if name == "temperature" else {}
    rod = make("rod", axes=turned(-0.5, 0.2, 0.9), position=(0.3, -0.2, 0.4), **warm)
    element = ELEMENTS[name](arm.at(0.1, 0.2, -0.1, axes=turned(0.3, 0.1, -0.6)), rod.at(*place))
    return mbd.System([arm, rod], forces=[element])


def applied(system: mbd.System, q: Tensor, v: Tensor, t: float = 0.3) -> tuple[Tensor, list]:
    """Generalized forces [n_v] and (s, s', f) of each kind of action."""
    T, data = system.topology, system("data")
    at = equations.placement(T, data, q, T.prescribed(tensor(t)[0]))
    g = equations.generalized_forces(T, data, at, equations.applied_on_vectors(T, data, at, v))
    states = equations.action_states(T, data, at, v)
    strengths = equations.strengths(T, data, states, at.t)
    result = [(s, r, f) for f, (s, r, _) in zip(strengths, states, strict=True)]
    return torch.cat([x.flatten(0, 1) for x in g])[:, 0, 0], result


@along
def test_power_is_force_times_rate(name):
    """s' by differences of s along the motion: neither `direction` nor the velocities of vectors enter."""
    system = system_of(name)
    T = system.topology
    q, v, _ = random_state(system, 5)
    g, states = applied(system, q, v)
    h = 1e-6
    ahead, behind = (applied(system, equations.advance(T, q, sign * h * v), v)[1] for sign in (1.0, -1.0))
    power = sum(float(((a[0] - b[0]) / (2.0 * h) * x[2]).sum()) for a, b, x in zip(ahead, behind, states, strict=True))
    assert float(g @ v[:, 0, 0]) == pytest.approx(power, rel=1e-7)


@between
def test_what_acts_between_two_bodies_keeps_the_momentum(name):
    system = system_of(name)
    T = system.topology
    q, v, _ = random_state(system, 6)
    data = system("data")
    at = equations.placement(T, data, q, T.prescribed(tensor(0.3)[0]))
    bare, none = replace(T, actions=[], beams=None), q.new_zeros(0, 1, 1)
    without, with_it = (equations.dynamic_residual(x, data, at, v, 0.0 * v, none)[:, 0, 0] for x in (bare, T))
    g = without - with_it
    force, torque = (g[k * T.bodies : (k + 3) * T.bodies].reshape(3, T.bodies) for k in (0, 3))
    r = q[: 3 * T.bodies].reshape(3, T.bodies)
    turned_torque = torch.einsum("ijn,jn->in", at.A[:, :, : T.bodies, 0, 0], torque[:, :2])
    assert_close(force.sum(1), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)
    moment = turned_torque + torch.linalg.cross(r, force, dim=0)
    assert float(force.abs().max()) + float(torque.abs().max()) > 1e-2
    assert_close(moment.sum(1), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)


@each
def test_the_iteration_matrix_knows_the_slopes_of_the_law(name):
    """By the rates, where the matrix is exact."""
    system = system_of(name)
    T, data = system.topology, system("data")
    q, v, a = random_state(system, 7)
    at = equations.placement(T, data, q, T.prescribed(tensor(0.3)[0]))
    lam = q.new_zeros(0, 1, 1)
    with_rates = system._saddle.matrix(data, at, Slopes(0.0, 1.0, v, a, lam))[0]
    plain = system._saddle.matrix(data, at)[0]

    def residual(rates: Tensor) -> Tensor:
        return equations.dynamic_residual(T, data, at, rates[:, None, None], a, lam)[:, 0, 0]

    expected = torch.func.jacfwd(residual)(v[:, 0, 0])
    assert_close(with_rates - plain, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "element",
    [
        lambda a, b: mbd.SpringDamper(a, b, stiffness=800.0, damping=2.0, rest=0.1),
        lambda a, b: mbd.RotationalSpringDamper(a, b, law=Table(((-2.0, 3.0), (0.5, -1.0), (2.0, -4.0)), damping=0.05)),
        lambda a, b: mbd.Bushing(a, b, 500.0, 1.0, 4.0, 0.01),
    ],
    ids=["spring", "table", "bushing"],
)
def test_gradients_are_those_of_the_discrete_map(element):
    arm = box("arm", axes=turned(0.4, -0.7, 0.3))
    rod = plate("rod", axes=turned(0.3, -0.6, 0.4), position=(0.3, -0.1, 0.2), modes=3)
    joint = mbd.Revolute(GROUND.at(), arm.at())
    system = mbd.System([arm, rod], [joint], [element(arm.at(0.1, 0.0, 0.0), rod.at("left"))], gravity=(0, 0, -9.81))
    names, angles = ["rod.laminate.angles"], system.body("rod").laminate.angles.detach()

    def final(x: Tensor) -> mbd.Trajectory:
        designs = {names[0]: x}
        return mbd.simulate(
            system, 0.02, steps=80, gradients="forward", variables=names, designs=designs, iterations=(4, 3)
        )

    h = 1e-5
    step = h * torch.eye(len(angles), dtype=torch.float64)
    motion = final(torch.cat([angles[None], angles + step, angles - step]))
    motion.require_ok()
    n, rigid = len(angles), slice(14)  # modal coordinates depend on the choice of the basis
    expected = (motion.q[1 : n + 1, -1, rigid] - motion.q[n + 1 :, -1, rigid]).T / (2.0 * h)
    assert_close(motion.dq_db[0, -1, rigid], expected, rtol=0, atol=2e-6 * float(expected.abs().max()))
    assert float(expected.abs().max()) > 1e-6


@pytest.mark.parametrize(
    "law",
    [
        Spring(3.0, 0.5, 0.2),
        Table(((-1.0, 2.0), (0.3, -0.5), (1.0, 4.0)), damping=0.2),
        Pieces((0.0, 0.6), (1.0, -0.5, 2.0), (0.3, -1.0, 0.7), width=0.1, damping=0.2),
        Gap(50.0, limit=0.1, damping=0.3, smooth=0.05),
    ],
    ids=lambda x: type(x).__name__,
)
def test_slopes_of_laws(law):
    make = torch.Generator().manual_seed(2)
    s, rate = (2.0 * torch.rand(2, 40, generator=make, dtype=torch.float64) - 1.0)[..., None, None]
    t, h = tensor(0.0)[0], 1e-7
    result = law.slopes(s, rate, t)
    for slope, own in zip(result, partial_derivatives(law, s, rate, t)[:2], strict=True):
        assert_close(slope, own, rtol=1e-12, atol=1e-12)
    differences = (
        (law(s + h, rate, t) - law(s - h, rate, t)) / (2 * h),
        (law(s, rate + h, t) - law(s, rate - h, t)) / (2 * h),
    )
    for slope, difference in zip(result, differences, strict=True):
        assert_close(slope, difference, rtol=1e-5, atol=1e-6)
