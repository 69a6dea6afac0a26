"""Laws of contact: slopes, no tension, momentum and power of a rolling sphere, gradients by all numbers, bad input."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, random_state, tensor, turned
from tests.refused import refused
from torchmbd.multibody.equations import equations
from torchmbd.multibody.forces.contact_law import ContactControl

pytestmark = pytest.mark.usefixtures("compiled")
GROUND = mbd.Ground()


def frames() -> tuple[mbd.Frame, mbd.Frame]:
    return GROUND.at(), box("box").at()


CONTACTS = {
    "point": partial(mbd.PlaneContact, stiffness=40.0, damping=0.3, exponent=1.5, friction=0.4, speed=0.5),
    "sphere": partial(mbd.PlaneContact, radius=0.3, stiffness=40.0, damping=0.3, friction=0.4, speed=0.5),
    "smooth sphere": partial(mbd.PlaneContact, radius=0.3, stiffness=40.0),
    "stops": partial(mbd.AxialStop, lower=-0.2, upper=0.3, stiffness=40.0, damping=0.7, exponent=1.3),
    "lower": partial(mbd.RotationalStop, lower=0.2, stiffness=40.0, damping=0.3),
    "upper": partial(mbd.RotationalStop, upper=-0.2, stiffness=40.0, exponent=2.0),
}


def control(name: str) -> ContactControl:
    return CONTACTS[name](*frames()).control


@pytest.mark.parametrize("name", CONTACTS)
def test_slopes_are_the_derivatives(name):
    law = control(name)
    x = torch.randn(law.inputs, 200, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x[2:, :5] *= 1e-5  # nearly sticking
    x[2:, 5] = 0.0
    numbers = law.numbers(x[:0])
    expected = torch.func.jacrev(lambda y: law.strengths(numbers, y).sum(1))(x)
    assert_close(law.slopes(numbers, x), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", CONTACTS)
def test_it_never_pulls(name):
    law = control(name)
    x = 5.0 * torch.randn(law.inputs, 2000, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    numbers = law.numbers(x[:0])
    gaps, _ = law.gaps(numbers, x)
    f = law.strengths(numbers, x)
    assert bool((f[:, (gaps > 0.0).all(0)] == 0.0).all())
    if name == "stops":
        assert bool((f[0, x[0] < -0.2] >= 0.0).all())
        assert bool((f[0, x[0] > 0.3] <= 0.0).all())
    else:
        assert bool((f[0] * (-1.0 if name == "upper" else 1.0) >= 0.0).all())
    if law.outputs > 1:
        slid = f[1:3].square().sum(0).sqrt()
        assert bool((slid <= 0.4 * f[0] * (1.0 + 1e-12)).all())


@pytest.mark.parametrize("name", CONTACTS)
def test_nothing_is_evaluated_where_nothing_touches(name, monkeypatch):
    law = control(name)
    x = 5.0 * torch.randn(law.inputs, 2000, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    numbers, p = law.numbers(x[:0]), x[:0, :1]
    if name == "stops":
        x[0] = 0.1 * torch.tanh(x[0])  # between the limits
    x = x[:, (law.gaps(numbers, x)[0] > 0.0).all(0)]
    assert x.shape[1] > 100
    expected = law.strengths(numbers, x), law.slopes(numbers, x)
    monkeypatch.setattr("torchmbd.multibody.forces.contact_law.normal_force", None)
    with torch.no_grad():
        assert_close(law.with_jacobian(p, x, 0.0), expected, rtol=0, atol=0)
        assert_close(law.at(p, x, 0.0), expected[0], rtol=0, atol=0)


def test_a_rolling_sphere_keeps_the_momentum_and_loses_what_it_rubs():
    table = box("table", axes=turned(0.4, -0.7, 0.3), position=(0.1, 0.0, 0.2))
    ball = box("ball", axes=turned(-0.5, 0.2, 0.9), position=(0.3, -0.2, 0.4))
    plane = table.at(0.1, 0.2, -0.1, axes=turned(0.3, 0.1, -0.6))
    element = mbd.PlaneContact(plane, ball.at(0.02, 0.01, 0.0), "y", 3.0, 20.0, 0.02, friction=0.4, speed=2.0)
    system = mbd.System([table, ball], forces=[element])
    T = system.topology
    q, v, _ = random_state(system, 6)
    data = system("data")
    at = equations.placement(T, data, q, T.prescribed(tensor(0.3)[0]))
    applied = equations.generalized_forces(T, data, at, equations.applied_on_vectors(T, data, at, v))
    g = torch.cat([x.flatten(0, 1) for x in applied])
    force, torque = (g[k * 2 : (k + 3) * 2, 0, 0].reshape(3, 2) for k in (0, 3))
    r = q[:6, 0, 0].reshape(3, 2)
    A = at.A[:, :, :2, 0, 0]
    moment = torch.einsum("ijn,jn->in", A, torque) + torch.linalg.cross(r, force, dim=0)
    assert float(force.abs().max()) > 1.0
    assert_close(force.sum(1), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert_close(moment.sum(1), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-11)
    assert_close(float(g[:, 0, 0] @ v[:, 0, 0]), _power_at_the_point(element, A, r, v), rtol=1e-10, atol=0)


def _power_at_the_point(element: mbd.PlaneContact, A: Tensor, r: Tensor, v: Tensor) -> float:
    """Force at the point of contact times the relative velocity of the material there, by rigid-body kinematics."""
    (a, b), law = element.frames, element.control
    axes = A[..., 0] @ a.axes  # columns, in ground axes
    n, t1, t2 = axes[:, 1], axes[:, 2], axes[:, 0]
    center = r[:, 1] + A[..., 1] @ b.point
    at, p0 = center - 3.0 * n, r[:, 0] + A[..., 0] @ a.point
    rates, spins = (v[k * 2 : (k + 3) * 2, 0, 0].reshape(3, 2) for k in (0, 3))
    w = [A[..., k] @ spins[:, k] for k in range(2)]
    u = [rates[:, k] + torch.linalg.cross(w[k], at - r[:, k]) for k in range(2)]
    u = u[1] - u[0]
    gap = (center - p0) @ n - 3.0
    x = torch.stack([gap + 3.0, u @ n, u @ t1, u @ t2, 0.0 * gap, 0.0 * gap])[:, None]
    f = law.strengths(law.numbers(x[:0]), x)[:3, 0]
    return float(f[0] * (u @ n) + f[1] * (u @ t1) + f[2] * (u @ t2))


def bouncing(height: float = 0.14, **given: object) -> mbd.System:
    ball = mbd.RigidBody(
        "ball",
        0.8,
        (4e-4,) * 3,
        position=(0.0, 0.0, height),
        velocity=(0.3, -0.1, -0.5),
        angular_velocity=(1.0, 4.0, 2.0),
    )
    floor = mbd.PlaneContact(GROUND.at(), ball.at(), name="floor", **given)
    return mbd.System([ball], forces=[floor], gravity=(0.0, 0.0, -9.81), free=["ball"])


NUMBERS = {
    "radius": 0.04,
    "stiffness": 4e3,
    "damping": 0.3,
    "exponent": 1.2,
    "friction": 0.3,
    "speed": 0.05,
}


@pytest.mark.thorough
@pytest.mark.parametrize(("backend", "height", "duration"), [("eager", 0.05, 0.08), ("native", 0.14, 0.3)])
def test_gradients_by_all_numbers(backend, height, duration):
    """Forward and reverse against differences of the same steps, on a path that bounces, slides and begins to roll."""
    steps = round(duration / 0.002)
    system = bouncing(height, **{name: mbd.variable(x) for name, x in NUMBERS.items()})
    names = [f"floor.{name}" for name in NUMBERS]
    values = torch.tensor(list(NUMBERS.values()), dtype=torch.float64)

    def final(x: Tensor, gradients: str) -> Tensor:
        designs = {name: x[..., i] for i, name in enumerate(names)}
        options = {"steps": steps, "iterations": (5, 4), "halvings": 0}
        motion = mbd.simulate(system, duration, designs=designs, gradients=gradients, backend=backend, **options)
        assert not [s for s in motion.status if s.startswith("failed")]
        return motion.q[:, -1, :3] + 0.1 * motion.v[:, -1, 3:6]

    def slopes(gradients: str) -> Tensor:
        x = values.clone()[None].requires_grad_()
        y = final(x, gradients)[0]
        return torch.stack([torch.autograd.grad(part, x, retain_graph=True)[0][0] for part in y])

    h = 1e-6 * values
    both = final(torch.cat([values + torch.diag(h), values - torch.diag(h)]), "none")
    n = len(values)
    expected = ((both[:n] - both[n:]) / (2.0 * h[:, None])).T
    size = (expected * values).abs().max()
    for gradients in ("reverse", "forward"):
        result = slopes(gradients)
        assert_close(result * values, expected * values, rtol=0, atol=2e-6 * float(size))
    assert bool(((expected * values).abs().amax(0) > 1e-4 * size).all())


@pytest.mark.thorough
def test_both_backends_agree():
    result = [
        mbd.simulate(bouncing(0.05, **NUMBERS), 0.08, steps=40, backend=backend, halvings=0).q
        for backend in ("eager", "native")
    ]
    assert_close(result[0], result[1], rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda a, b: mbd.AxialStop(a, b), "axialstop_ground_box"),
        (lambda a, b: mbd.AxialStop(a, b, lower=0.2, upper=0.1), "axialstop_ground_box.lower"),
        (lambda a, b: mbd.RotationalStop(a, b, lower=-4.0, upper=4.0), "rotationalstop_ground_box.limits"),
        (lambda a, b: mbd.PlaneContact(a, b, stiffness=-1.0), "planecontact_ground_box.stiffness"),
        (lambda a, b: mbd.PlaneContact(a, b, stiffness=mbd.variable(0.0)), "planecontact_ground_box.stiffness"),
        (lambda a, b: mbd.PlaneContact(a, b, exponent=0.5), "planecontact_ground_box.exponent"),
        (lambda a, b: mbd.PlaneContact(a, b, friction=-0.1), "planecontact_ground_box.friction"),
        (lambda a, b: mbd.PlaneContact(a, b, friction=0.1, speed=0.0), "planecontact_ground_box.speed"),
        (lambda a, b: mbd.PlaneContact(a, b, radius=float("nan")), "planecontact_ground_box.radius"),
        (lambda a, b: mbd.PlaneContact(a, b, normal="w"), "axis"),
        (lambda a, b: mbd.PlaneContact(a, a), "b"),
        (lambda a, b: mbd.AxialStop(a, b, upper="far"), "axialstop_ground_box.upper"),
    ],
)
def test_bad_input(make, path):
    with refused(path):
        make(*frames())
