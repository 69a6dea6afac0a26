"""Equilibria as motions, and motions that start at rest or where a caller says: closed forms, projection, failures."""

from __future__ import annotations

import math

import pytest
import torch
from torch.autograd import forward_ad
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, finished, laminate, pendulum, plate, tensor
from tests.refused import refused

GROUND = mbd.Ground()
EI, L = 2.1e11 * 1e-9, 1.0


def cantilever(push: float = 0.0, gravity: float = 0.0, **more) -> mbd.System:
    """A slender beam on a wall, with a load that grows in time at its end."""
    line = mbd.BeamLine.straight(L, 8)
    section = mbd.GivenSection.isotropic(E=2.1e11, nu=0.3, density=7800.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)
    body = mbd.FlexibleBody.beam("bar", line, section, modes=6, reference="start", **more)
    force = mbd.Force(body.at("end"), lambda t: torch.stack([0.0 * t, 0.0 * t, push * t]), name="push")
    return mbd.System(
        [body], [mbd.Fixed(GROUND.at(), body.at("start"), name="wall")], [force], gravity=(0, 0, -gravity)
    )


def sag(motion: mbd.Trajectory) -> torch.Tensor:
    return motion.body("bar").at("end").position[..., 2].detach()


@pytest.mark.thorough
def test_quasi_static_steps_have_the_closed_form():
    """Tip deflection F L^3 / 3 EI and the moment at the wall, at every time; energy F^2 L^3 / 6 EI."""
    times = [0.0, 0.5, 1.0]
    rest = mbd.equilibrium(cantilever(push=-2.0), times=times)
    assert isinstance(rest, mbd.Trajectory)
    assert rest.t.tolist() == times
    force = -2.0 * rest.t
    assert_close(sag(rest)[0], force * L**3 / (3 * EI), rtol=3e-3, atol=0)
    assert_close(rest.reaction("wall").torque[0, :, 1].detach().abs(), 2.0 * rest.t * L, rtol=1e-6, atol=1e-9)
    assert_close(rest.energies.strain[0], force**2 * L**3 / (6 * EI), rtol=3e-3, atol=0)
    assert float(rest.v.abs().max()) == 0.0
    assert rest.stable


@pytest.mark.thorough
def test_a_path_of_values_is_followed():
    body = box("load", center=(0.0, 0.0, 0.0))
    spring = mbd.AxialSpringDamper(GROUND.at(), body.at(), axis="x", stiffness=mbd.variable(100.0), name="spring")
    push = mbd.Force(body.at(), (mbd.variable(0.0), 0.0, 0.0), name="push")
    system = mbd.System([body], [mbd.Prismatic(GROUND.at(), body.at(), axis="x")], [spring, push])
    values = torch.linspace(0.0, 30.0, 4, dtype=torch.float64)
    rest = mbd.equilibrium(system, designs={"push.x": values}, follow=True)
    assert_close(rest.body("load").r[:, 0, 0].detach(), values / 100.0, rtol=1e-9, atol=1e-12)


@pytest.mark.thorough
def test_a_motion_from_rest_stays_there():
    system = cantilever(gravity=9.81)
    calm, swing = (sag(finished(mbd.simulate(system, 0.05, steps=50, start=s))) for s in ("equilibrium", "assembled"))
    static = -7800 * 1e-4 * 9.81 * L**4 / (8 * EI)
    assert float(calm.max() - calm.min()) < 1e-9 * abs(static)
    assert float(swing.min() / swing[0, 0].abs().clamp_min(abs(static))) < -1.8
    assert float(calm[0, 0]) == pytest.approx(static, rel=1e-2)
    again = mbd.simulate(system, 0.05, steps=50, start=mbd.equilibrium(system))
    assert_close(sag(again), calm, rtol=0, atol=1e-9 * abs(static))


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["dopri5", "hht_alpha"])
def test_every_method_starts_at_rest(method):
    system = pendulum()
    motion = finished(mbd.simulate(system, 0.01, steps=4, method=method, start="equilibrium"))
    rest = mbd.equilibrium(system)
    assert_close(motion.q[0, 0], rest.q[0, 0], rtol=0, atol=1e-10)
    assert float(motion.body("arm").omega[0, 0].detach().norm()) > 0.5  # rates are as given, as far as hinges allow


@pytest.mark.thorough
def test_what_is_given_is_projected():
    """Two links: a position that does not close and a rate that the hinge forbids; modal coordinates are kept."""
    system = pendulum()
    start = {
        "arm.position": tensor(0.11, 0.05, -0.02),
        "rod.modal": tensor(1e-3, -2e-3),
        "rod.modal_velocity": tensor(0.0, 0.1),
    }
    motion = finished(mbd.simulate(system, 0.004, steps=4, start=start))
    body = motion.body("rod")
    assert_close(body.w[0, 0].detach(), start["rod.modal"], rtol=0, atol=0)
    assert_close(body.wd[0, 0].detach(), start["rod.modal_velocity"], rtol=0, atol=0)
    ends = motion.body("arm").at((0.2, 0.1, -0.05)).position, body.at("left").position
    assert_close(ends[0][0, 0], ends[1][0, 0], rtol=0, atol=1e-10)
    lanes = {"rod.modal": torch.stack([start["rod.modal"], 0.0 * start["rod.modal"]])}
    both = mbd.simulate(system, 0.004, steps=4, start=lanes)
    assert both.lanes == 2
    assert_close(both.body("rod").w[:, 0].detach(), lanes["rod.modal"], rtol=0, atol=0)
    assert both.body("rod").nodes.shape[0] == 2


@pytest.mark.thorough
def test_two_halves_make_a_whole():
    system = pendulum()
    whole = finished(mbd.simulate(system, 0.02, steps=40))
    half = mbd.simulate(system, 0.01, steps=20)
    rest = finished(mbd.simulate(system, 0.01, steps=20, start=half))
    assert_close(rest.q[0, -1], whole.q[0, -1], rtol=0, atol=2e-6)


def falling() -> mbd.System:
    a = box("a")
    return mbd.System([a], [mbd.Prismatic(GROUND.at(), a.at(), axis="y")], gravity=(0.0, -9.81, 0.0))


def rolling() -> mbd.System:
    """Nothing holds the wheel about its axis; the rod beside it rests well."""
    a = box("a", center=(0.0, 0.0, 0.0))
    return mbd.System([a], [mbd.Revolute(GROUND.at(), a.at(), axis="z")], gravity=(0.0, -9.81, 0.0))


def upright() -> mbd.System:
    a = box("a", center=(0.0, 0.1, 0.0))
    return mbd.System([a], [mbd.Revolute(GROUND.at(), a.at(), axis="z")], gravity=(0.0, -9.81, 0.0))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("system", "words"),
    [
        (falling, "no static equilibrium"),
        (rolling, "free to move without a force: rotation z of 'a'"),
        (upright, "unstable: rotation z of 'a'"),
    ],
)
def test_no_equilibrium_is_a_status(system, words):
    motion = mbd.simulate(system(), 0.1, steps=10, start="equilibrium")
    assert words in motion.status[0]
    assert bool(motion.q.isnan().all())
    with pytest.raises(mbd.SimulationFailure, match="Try: "):
        motion.require_ok()


@pytest.mark.thorough
def test_a_lane_without_equilibrium_leaves_the_others_alone():
    body = box("load", center=(0.0, 0.0, 0.0))
    spring = mbd.AxialSpringDamper(GROUND.at(), body.at(), axis="y", stiffness=mbd.variable(100.0), name="spring")
    system = mbd.System([body], [mbd.Prismatic(GROUND.at(), body.at(), axis="y")], [spring], gravity=(0, -10.0, 0))
    k = tensor(100.0, 1e-9, 200.0).requires_grad_()
    motion = mbd.simulate(system, 0.1, steps=10, start="equilibrium", designs={"spring.stiffness": k})
    assert [s.startswith("failed") for s in motion.status] == [False, True, False]
    y = motion.sound(motion.body("load").r[:, -1, 1])
    y[[0, 2]].sum().backward()
    assert_close(k.grad, 7.0 / k.detach() ** 2 * tensor(1.0, 0.0, 1.0), rtol=1e-6, atol=1e-12)


@pytest.mark.thorough
def test_problems_start_at_rest():
    problem = mbd.Problem(pendulum(), 0.004, mbd.Mean(mbd.StrainEnergy("rod")), start="equilibrium", steps=4)
    other = mbd.Problem(pendulum(), 0.004, mbd.Mean(mbd.StrainEnergy("rod")), motion_start="equilibrium", steps=4)
    one, two = (p.evaluate(p.start[None], True)[0] for p in (problem, other))
    assert one.objective == two.objective
    assert one.objective > 0.0


@pytest.mark.thorough
def test_bad_starts_are_named():
    system = pendulum()
    for start, path in (
        ("equilibriun", "start"),
        (3.0, "start"),
        ({"rod.modal": [1.0]}, "start.rod.modal"),
        ({"rod.mode": [1.0, 0.0]}, "start.rod.mode"),
        ({"arm.modal": [1.0, 0.0]}, "start.arm.modal"),
        ({"arm.axes": [[1.0, 0, 0], [0, 2.0, 0], [0, 0, 1.0]]}, "start.arm.axes"),
        ({"arm.velocity": [math.nan, 0.0, 0.0]}, "start.arm.velocity"),
        (mbd.equilibrium(cantilever(gravity=1.0)), "start"),
    ):
        with refused(path):
            mbd.simulate(system, 0.01, steps=2, start=start)
    with refused("times", [0.0, 0.0]):
        mbd.equilibrium(system, times=[0.0, 0.0])
    with refused("start"):
        mbd.simulate(
            system,
            0.01,
            steps=2,
            gradients="forward",
            start={"rod.modal": tensor(0.0, 0.0).requires_grad_()},
        )


@pytest.mark.thorough
def test_stresses_of_an_equilibrium():
    """Plies of a plate under its own weight: the failure index is that of the motion that stays at rest."""
    body = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3), reference="left")
    system = mbd.System([body], [mbd.Fixed(GROUND.at(), body.at("left"))], gravity=(0.0, 0.0, -9.81))
    rest, motion = mbd.equilibrium(system), mbd.simulate(system, 0.01, steps=4, start="equilibrium")
    one, other = (mbd.PlyHistory(m, "rod").stress().detach() for m in (rest, motion))
    assert float(one.abs().max()) > 1e3
    assert_close(one[:, 0], other[:, -1], rtol=1e-6, atol=1e-3)


@pytest.mark.extensions
@pytest.mark.thorough
def test_frequencies_have_derivatives_in_every_mode():
    """Once they had values only, and dual numbers were refused."""
    arm, angles = mbd.examples.arm(), mbd.deg([45.0, -45.0])
    ones = torch.tensor([1.0, -0.3], dtype=torch.float64)

    def first(x: torch.Tensor) -> torch.Tensor:
        return mbd.equilibrium(arm, designs={"arm.laminate.angles": x}).frequencies[0, 1]

    _, forward = torch.func.jvp(first, (angles,), (ones,))
    with forward_ad.dual_level():
        dual = forward_ad.unpack_dual(first(forward_ad.make_dual(angles, ones))).tangent
    reverse = torch.func.grad(first)(angles) @ ones
    expected = (first(angles + 1e-5 * ones) - first(angles - 1e-5 * ones)) / 2e-5
    assert_close(forward, dual, rtol=1e-12, atol=0.0)
    assert_close(forward, reverse, rtol=1e-9, atol=0.0)
    assert_close(forward, expected, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(
    ("designs", "start", "argument", "words"),
    [
        (3, 1, "designs", "'bob.mass': 3, 'spin': 2"),
        (1, 3, "spin", "'start': 3, 'spin': 2"),
        (3, 4, "designs", "'bob.mass': 3, 'start': 4, 'spin': 2"),
    ],
)
def test_the_argument_whose_lanes_differ_is_named(designs, start, argument, words):
    bob = mbd.RigidBody("bob", mbd.variable(1.0), (0.1, 0.1, 0.1), position=(0.0, 0.0, -1.0))
    system = mbd.System([bob], [mbd.Spherical(mbd.Ground().at(), bob.at(0.0, 0.0, 1.0))], gravity=(0.0, 0.0, -9.81))
    lanes = {"bob.mass": torch.linspace(1.0, 2.0, designs, dtype=torch.float64)}
    guess = {"bob.position": tensor(0.0, 0.0, -1.0).expand(start, 3)}
    with pytest.raises(mbd.InputError, match=words) as caught:
        mbd.equilibrium(system, designs=lanes, start=guess, spin=tensor([0.0, 0.0, 1.0], [0.0, 0.0, 2.0]))
    assert caught.value.argument == argument
