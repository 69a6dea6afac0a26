"""Contacts that fixed steps pass over or cut short: found, named, and made with smaller steps; derivatives go through."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import warned
from torchmbd.integrate.contacts import STEPS, UnresolvedContact, lowest
from torchmbd.integrate.lane_status import mark_unresolved_contacts

pytestmark = pytest.mark.usefixtures("compiled")
GROUND = mbd.Ground()
G, K, MASS = 9.81, 1e5, 1.0


def thrown(above: float = 1e-5, height: float = 1.0, **given: object) -> mbd.System:
    """A ball thrown up; free of the ceiling it would rise so far above it."""
    speed = math.sqrt(2.0 * G * (height + above))
    ball = mbd.RigidBody("ball", MASS, (0.01,) * 3, velocity=(0.0, 0.0, speed))
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    ceiling = mbd.PlaneContact(GROUND.at(0.0, 0.0, height, axes=down), ball.at(), stiffness=K, name="ceiling", **given)
    return mbd.System([ball], forces=[ceiling], gravity=(0.0, 0.0, -G), free=["ball"])


def dropped(height: float = 0.1, **given: object) -> mbd.System:
    ball = mbd.RigidBody("ball", MASS, (0.01,) * 3, position=(0.0, 0.0, height))
    floor = mbd.PlaneContact(GROUND.at(), ball.at(), name="floor", **({"stiffness": K} | given))
    return mbd.System([ball], forces=[floor], gravity=(0.0, 0.0, -G), free=["ball"])


@pytest.mark.thorough
def test_the_least_of_cubics():
    gap, rate = torch.randn(2, 400, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    h = 0.7
    u = torch.linspace(0.0, 1.0, 20001, dtype=torch.float64)[:, None]
    a, b, m, n = gap[:-1], gap[1:], h * rate[:-1], h * rate[1:]
    x = a + u * (m + u * (3.0 * (b - a) - 2.0 * m - n + u * (2.0 * (a - b) + m + n)))
    assert_close(lowest(gap, rate, h), x.amin(0), rtol=0, atol=1e-7)
    flat = torch.tensor([1.0, 1.0, 0.5], dtype=torch.float64)  # a parabola and a line: no cube, no square
    assert_close(
        lowest(flat[:2], torch.tensor([-4.0, 4.0]).double(), 1.0), torch.tensor([0.0]).double(), rtol=0, atol=1e-14
    )
    assert_close(lowest(flat[1:], torch.tensor([-0.5, -0.5]).double(), 1.0), torch.tensor([0.5]).double())


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["eager", "native"])
def test_a_contact_shorter_than_a_step_is_found(backend):
    """It lasts 3 ms; steps take 12 ms, and both ends of each are apart."""
    system, duration = thrown(height=0.05), 0.21
    options = {"steps": 18, "gradients": "none", "backend": backend}
    missed = mbd.simulate(system, duration, halvings=0, **options)
    assert missed.status[0].startswith("failed: contact 'ceiling' of 'ground' and 'ball' between t = 0.093")
    if backend == "eager":
        return  # what follows makes thousands of steps, and is the same code
    result = mbd.simulate(system, duration, **options).require_ok()
    assert result.stats["halved"] == [0]
    fine = mbd.simulate(system, duration, **options | {"steps": 18 * 256}).require_ok()
    assert float(fine.q[0, :, 2].max()) > 0.05
    assert_close(result.q[:, -1], fine.q[:, -1], rtol=0, atol=2e-5)
    z = [float(x.q[0, -1, 2]) for x in (missed, result)] if torch.isfinite(missed.q).all() else [0.0, 1.0]
    assert abs(z[0] - z[1]) > 1e-4


@pytest.mark.thorough
def test_a_contact_of_few_steps_gets_more():
    exact = 0.1
    period = 2.0 * math.sqrt(2.0 * exact / G) + _contact_time()
    with warned("contact 'floor' of 'ground' and 'ball'", "t = 0.1"):
        short = mbd.simulate(dropped(), period, steps=100, gradients="none", halvings=0)
    assert short.status[0].startswith("unresolved: contact 'floor'")
    assert f"must last {STEPS} steps" in short.status[0]
    result = mbd.simulate(dropped(), period, steps=100, gradients="none").require_ok()
    assert result.q.shape[1] == 101
    assert float(result.q[0, -1, 2]) == pytest.approx(exact, rel=1e-3)
    assert abs(float(short.q[0, -1, 2]) - exact) > 1e-3


def _contact_time(k: float = K, height: float = 0.1) -> float:
    w, v = math.sqrt(k / MASS), math.sqrt(2.0 * G * height)
    return 2.0 / w * (math.pi - math.atan(v * w / G))


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [8, 31])
def test_a_contact_that_the_end_cuts_off(steps):
    """Deepest after t_0 + pi / 2 w, where the motion ends: by few steps of the whole as by many, to 2 % of the depth."""
    fall, w = math.sqrt(2.0 * 0.1 / G), math.sqrt(2e4 / MASS)
    duration = fall + (math.pi / 2.0 + math.atan(1.0 / (w * fall))) / w
    depth = (G + math.sqrt(G**2 + 2.0 * G * 0.1 * w**2)) / w**2
    motion = mbd.simulate(dropped(stiffness=2e4), duration, steps=steps, gradients="none").require_ok()
    assert motion.stats["halved"] == [0]
    assert mbd.Final(mbd.Position("ball", "z"))(motion).item() == pytest.approx(-depth, rel=0.02)


@pytest.mark.thorough
def test_a_contact_that_no_steps_show_keeps_its_status():
    with warned("contact 'floor'"):
        motion = mbd.simulate(dropped(0.01, stiffness=1e13), 0.06, steps=6, gradients="none")
    assert "contact 'floor'" in motion.status[0]


@pytest.mark.thorough
def test_steps_are_chosen_for_contacts():
    motion = mbd.simulate(dropped(stiffness=1e6), 0.28, gradients="none").require_ok()
    assert motion.stats["steps"] > 1000
    assert not motion.stats.get("halved")


@pytest.mark.thorough
def test_lanes_get_what_they_need():
    system = dropped(stiffness=mbd.variable(K))
    designs = {"floor.stiffness": torch.tensor([1e2, 1e5], dtype=torch.float64)}
    motion = mbd.simulate(system, 0.28, steps=300, designs=designs, gradients="none").require_ok()
    assert motion.stats["halved"] == [1]
    alone = mbd.simulate(dropped(stiffness=1e2), 0.28, steps=300, gradients="none")
    assert_close(motion.q[0], alone.q[0], rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_gradients_of_lanes_are_those_of_each_alone():
    """Two lanes have smaller steps, in one run; they go back together, and give the gradient that each has alone."""
    system = dropped(stiffness=mbd.variable(K), damping=0.1)
    stiffness = torch.tensor([1e2, 2e4, 1e2, 1.8e4], dtype=torch.float64)

    def gradient(k: Tensor) -> tuple[Tensor, mbd.Trajectory]:
        k = k.clone().requires_grad_()
        motion = mbd.simulate(system, 0.25, steps=60, designs={"floor.stiffness": k}, iterations=(5, 4)).require_ok()
        return torch.autograd.grad(motion.q[:, -1, 2].sum(), k)[0], motion

    together, motion = gradient(stiffness)
    assert motion.stats["halved"] == [1, 3]
    (runs,) = motion.integration.adjoint._runs.values()
    assert [run.lanes for run in runs] == [[0, 2], [1, 3]]
    alone = torch.cat([gradient(k[None])[0] for k in stiffness])
    assert float(alone[1].abs()) > 0
    assert_close(together, alone, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("gradients", ["reverse", "forward"])
def test_a_lane_does_not_depend_on_its_company(gradients):
    """Lanes that need different steps, or none: states and gradients are those of each alone, with tangents and without."""
    system = dropped(stiffness=mbd.variable(K), damping=0.1)
    stiffness = torch.tensor([1e2, 5e3, 4e5, 4e4, 5.2e3], dtype=torch.float64)
    end = mbd.Final(mbd.Position("ball", "z"))

    def ended(k: Tensor, gradients: str) -> mbd.Trajectory:
        return mbd.simulate(system, 0.25, steps=40, designs={"floor.stiffness": k}, gradients=gradients).require_ok()

    together = ended(stiffness, gradients)
    assert len(set(together.integration.results.replaced.values())) > 1
    value, slope = end.value_and_gradient(together)
    for lane, k in enumerate(stiffness):
        alone = ended(k[None], gradients)
        assert_close(together.q[lane], alone.q[0], rtol=0, atol=1e-12)
        assert_close(ended(k[None], "none").q[0], alone.q[0], rtol=0, atol=1e-12)
        one, its_slope = end.value_and_gradient(alone)
        assert_close(value[lane], one[0], rtol=1e-12, atol=0)
        assert_close(slope[lane], its_slope[0], rtol=1e-7, atol=1e-16)


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["reverse", "forward"])
def test_derivatives_go_through_smaller_steps(gradients):
    system = dropped(stiffness=mbd.variable(2e4), damping=0.1)

    def final(k: Tensor) -> Tensor:
        motion = mbd.simulate(
            system, 0.25, steps=60, designs={"floor.stiffness": k}, gradients=gradients, iterations=(5, 4)
        ).require_ok()
        assert motion.stats["halved"] == list(range(len(k)))
        return motion.q[:, -1, 2]

    k = torch.tensor([2e4], dtype=torch.float64, requires_grad=True)
    [slope] = torch.autograd.grad(final(k).sum(), k)
    with torch.no_grad():
        near = final(torch.tensor([2e4 + 0.02, 2e4 - 0.02], dtype=torch.float64, requires_grad=True))
    assert float(slope) == pytest.approx(float(near[0] - near[1]) / 0.04, rel=1e-6)


@pytest.mark.thorough
def test_outputs_of_other_methods_and_phases():
    with warned("is not seen in its outputs"):
        motion = mbd.simulate(thrown(), 0.9, "rk4", steps=80, gradients="none")
    assert motion.status[0].startswith("unresolved: contact 'ceiling'")
    phases = [mbd.Phase(until=0.1), mbd.Phase()]
    motion = mbd.simulate(thrown(), 0.9, steps=80, phases=phases, gradients="none", halvings=0)
    assert motion.status[0].startswith("failed: contact 'ceiling'")


@pytest.mark.thorough
def test_states_that_are_not_kept_show_contacts():
    motion = mbd.simulate(thrown(), 0.9, steps=80, gradients="none", checkpoint=10, halvings=0)
    assert motion.status[0].startswith("failed: contact 'ceiling'")


@pytest.mark.thorough
def test_a_plane_on_a_driven_body():
    """The table is prescribed, and no unknown of the steps; the ball rests on it."""
    table = mbd.RigidBody("table", 1.0, (0.01,) * 3)
    slide = mbd.Prismatic(GROUND.at(), table.at(), axis="z")
    lift = mbd.Drive(GROUND, table, axis="z", position=lambda t: 0.05 * torch.sin(3.0 * t))
    ball = mbd.RigidBody("ball", MASS, (0.01,) * 3, position=(0.1, 0.0, -MASS * G / K), velocity=(0.0, 0.0, 0.15))
    top = mbd.PlaneContact(table.at(), ball.at(), stiffness=K, damping=2.0, name="top")
    system = mbd.System([table, ball], [slide, lift], [top], gravity=(0.0, 0.0, -G), free=["ball"])
    motion = mbd.simulate(system, 0.5, steps=1000, gradients="none").require_ok()
    gap = motion.body("ball").r[0, :, 2] - motion.body("table").r[0, :, 2]
    assert float((gap + MASS * G / K).abs().max()) < 2e-5


@pytest.mark.thorough
def test_nothing_is_found_where_bodies_rest():
    for height in (0.0, -MASS * G / K):
        motion = mbd.simulate(dropped(height, damping=1.0), 0.1, steps=1000, gradients="none")
        assert motion.status == ["ok"]
        assert not motion.stats.get("halved")


def test_a_contact_does_not_hide_a_failure():
    status = ["failed: the motion is not finite from t = 0.1 s on", "ok"]
    contact = UnresolvedContact("contact 'floor' of 'ground' and 'ball' from t = 0.05 s on lasts 3 steps", 8, False)
    mark_unresolved_contacts(status, {0: contact, 1: contact})
    assert status == ["failed: the motion is not finite from t = 0.1 s on", f"unresolved: {contact.message}"]


def impact(k: Tensor | float = 2e4) -> mbd.System:
    return dropped(stiffness=k, damping=0.1)


ACCELERATION, SPEED = mbd.Acceleration("ball", "z"), mbd.Velocity("ball", "z")


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [31, 60])
def test_responses_see_the_smaller_steps(steps):
    """Peaks, integrals and energies are those of fine outputs: of coarse ones the contact was lost, with the status ok.

    An acceleration has a kink where the contact begins or ends; a cubic through it went beyond the free fall by 25 %.
    """
    motion = mbd.simulate(impact(), 0.25, steps=steps, gradients="none").require_ok()
    fine = mbd.simulate(impact(), 0.25, steps=6000, gradients="none").require_ok()
    assert motion.stats["halved"] == [0]
    assert motion.q.shape[1] == steps + 1
    for measure in (mbd.Max(ACCELERATION), mbd.Min(mbd.Position("ball", "z")), mbd.RMS(ACCELERATION)):
        assert_close(measure(motion), measure(fine), rtol=5e-3, atol=0.0)
    change = mbd.Final(SPEED)(motion)
    assert_close(mbd.Integral(ACCELERATION)(motion), change, rtol=0, atol=5e-3 * float(mbd.Max(SPEED)(fine)))
    assert float(motion.energies.balance.abs().max()) < 5e-3 * MASS * G * 0.1
    assert float(mbd.Min(ACCELERATION)(motion)) == pytest.approx(-G, rel=1e-9)
    if "fatigue" in mbd.__all__:  # the extension fatigue is there
        load = mbd.fatigue.EquivalentLoad(ACCELERATION, exponent=3.0, cycles=1.0)
        assert_close(load(motion), load(fine), rtol=5e-3, atol=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["reverse", "forward"])
def test_derivatives_of_responses_at_smaller_steps(gradients):
    """By the stiffness of two lanes, of which one is soft enough for the steps that were asked for."""
    system, measure = impact(mbd.variable(2e4)), mbd.Max(ACCELERATION) + mbd.Integral(ACCELERATION**2)

    def value(k: Tensor, gradients: str = gradients) -> Tensor:
        designs = {"floor.stiffness": k}
        return measure(mbd.simulate(system, 0.2, steps=60, designs=designs, gradients=gradients, iterations=(6, 4)))

    k = torch.tensor([2e4, 2e2], dtype=torch.float64, requires_grad=True)
    [slope] = torch.autograd.grad(value(k).sum(), k)
    with torch.no_grad():
        up, down = (value(k * (1.0 + d), "none") for d in (1e-6, -1e-6))
    assert_close(slope, (up - down) / (2e-6 * k.detach()), rtol=2e-5, atol=0.0)


@pytest.mark.thorough
def test_smaller_steps_under_vmap():
    system, measure = impact(mbd.variable(2e4)), mbd.Max(ACCELERATION)

    def value(k: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.2, steps=60, designs={"floor.stiffness": k[None]}, iterations=(6, 4))
        return measure(motion)[0]

    k = torch.tensor([2e4, 2e2], dtype=torch.float64)
    expected = torch.stack([value(x) for x in k])
    assert_close(torch.func.vmap(value)(k), expected, rtol=1e-12, atol=0.0)
    tangents = torch.func.vmap(lambda x: torch.func.jvp(value, (x,), (torch.ones_like(x),))[1])(k)
    gradients = torch.stack([torch.func.grad(value)(x) for x in k])
    assert_close(tangents, gradients, rtol=1e-7, atol=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "law",
    [
        mbd.forces.Gap(2e4),
        mbd.forces.Scaled(2.0, mbd.forces.Gap(1e4)),
        mbd.forces.Scaled(mbd.variable(1.0), mbd.forces.Gap(2e4)),
    ],
    ids=["gap", "scaled", "variable"],
)
def test_stops_by_a_gap_are_watched(law):
    """As planes are: the energy after a stop that steps pass over was 5.6 times that before, with the status ok."""
    ball = mbd.RigidBody("ball", MASS, (0.01,) * 3, position=(0.0, 0.0, 0.1))
    stop = mbd.AxialSpringDamper(GROUND.at(), ball.at(), axis="z", law=law, name="stop")
    system = mbd.System([ball], forces=[stop], gravity=(0.0, 0.0, -G), free=["ball"])
    with warned("Gap"):
        short = mbd.simulate(system, 0.25, steps=31, gradients="none", halvings=0)
    assert short.status[0].startswith("unresolved: contact by Gap(limit=0, sign=1) from t = 0.1")
    motion = mbd.simulate(system, 0.25, steps=31, gradients="none").require_ok()
    assert motion.stats["halved"] == [0]
    w = math.sqrt(2e4 / MASS)
    deepest = (G + math.sqrt(G**2 + 2.0 * G * 0.1 * w**2)) / w**2
    # Twenty steps in contact.
    assert float(mbd.Min(mbd.Position("ball", "z"))(motion)) == pytest.approx(-deepest, rel=5e-3)
    assert float(motion.energies.balance.abs().max()) < 5e-3 * MASS * G * 0.1
