"""Sensitivities through events, locks, releases and impacts: closed forms, and differences of the same discrete map."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, pendulum, tensor
from torchmbd.integrate import Trajectory

pytestmark = pytest.mark.thorough

HEIGHT, RESTITUTION, DURATION = 1.0, 0.8, 1.5
STEP, DIRECTION = 1e-4, tensor(1.0, 0.4)  # [rad] of differences; with half of it rounding shows
NAME = "rod.laminate.angles"
DOWN = tensor(0.0, 0.0, -1.0)


def falling_mass() -> mbd.System:
    """A mass in a gravity field that is a design variable."""
    mass = mbd.RigidBody("mass", mass=2.0, inertia=(0.1, 0.2, 0.2), position=(0.0, 0.0, HEIGHT))
    return mbd.System([mass], gravity=nn.Parameter(tensor(0.0, 0.0, -9.81)))


def bounces(g: Tensor) -> tuple[Tensor, Tensor]:
    """Times of the first two impacts."""
    first = torch.sqrt(2.0 * HEIGHT / g)
    return first, (1.0 + 2.0 * RESTITUTION) * first


def bouncing(t: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    """Height and velocity at time t."""
    first, second = bounces(g)
    if t < first:
        return HEIGHT - 0.5 * g * t * t, -g * t
    speed, start = RESTITUTION * g * first, first
    if t >= second:
        speed, start = RESTITUTION * speed, second
    return speed * (t - start) - 0.5 * g * (t - start) ** 2, speed - g * (t - start)


def rebound(motion: Trajectory) -> Tensor:
    """The same restitution as a map of the velocities."""
    flip = torch.ones(6, dtype=torch.float64).index_fill(0, torch.tensor([2]), -RESTITUTION)
    return motion.v * flip


@pytest.mark.parametrize(
    ("method", "impact"), [("generalized_alpha", RESTITUTION), ("generalized_alpha", rebound), ("rk4", RESTITUTION)]
)
def test_bouncing_mass_has_its_closed_form(method, impact):
    """Three designs in one batch, whose impacts lie between different output times."""
    fields = tensor(9.81, 7.0, 20.0)
    landing = mbd.Event(mbd.Position("mass", axis="z"), "falling")
    phases = [mbd.Phase(until=landing, impact=impact)] * 2 + [mbd.Phase()]
    motion = mbd.simulate(
        falling_mass(),
        DURATION,
        method,
        40,
        gradients="forward",
        variables=["gravity"],
        designs={"gravity": fields[:, None] * DOWN},
        phases=phases,
    ).require_ok()
    assert motion.dq_db is not None
    assert motion.dv_db is not None
    for lane, g in enumerate(fields):
        exact = torch.stack([torch.stack(bouncing(t, g)) for t in motion.t])
        slopes = torch.stack(
            [torch.stack(torch.func.jacfwd(lambda g, t=t: bouncing(t, g))(g)) for t in motion.t]  # pyright: ignore
        )
        assert_close(torch.stack([motion.q[lane, :, 2], motion.v[lane, :, 2]], 1), exact, rtol=0, atol=1e-10)
        result = torch.stack([motion.dq_db[lane, :, 2] @ DOWN, motion.dv_db[lane, :, 2] @ DOWN], 1)
        assert_close(result, slopes, rtol=0, atol=1e-10)
        rates = torch.func.jacfwd(bounces)(g)
        for switch, time, rate in zip(motion.switches, bounces(g), rates, strict=True):
            assert switch.dt_db is not None
            assert_close(switch.t[lane], time, rtol=0, atol=1e-11)
            assert_close(switch.dt_db[lane] @ DOWN, rate, rtol=0, atol=1e-11)


def tip(motion: Trajectory) -> Tensor:
    """Passes zero at about 0.04 s, and depends on the mode shapes."""
    return motion.body("rod").at("right").position[..., 2] + 0.022


# A lock at an event, a lock for a while after it, and a body let go.
PHASES = [
    mbd.Phase(until=mbd.Event(tip)),
    mbd.Phase(lasting=0.013, lock=["universal_arm_rod"]),
    mbd.Phase(lasting=0.011, lock=["revolute_ground_arm"]),
    mbd.Phase(release=["revolute_ground_arm"]),
]


@pytest.fixture(scope="module")
def swing() -> mbd.System:
    return pendulum(damping=1e-4)


def driven() -> mbd.System:
    """The same with what depends on time: a drive, whose constraint moves, and a force; and with a spring-damper."""
    free = pendulum(damping=1e-4)
    arm, rod, hinge = free.body("arm"), free.body("rod"), free.joints[0]
    return mbd.System(
        bodies=[arm, rod],
        joints=[
            *free.joints,
            mbd.Drive(hinge.a, arm, axis="x", angle=lambda t: 0.2 * torch.sin(30.0 * t), name="motor"),
        ],
        forces=[
            mbd.Force(rod.at("right"), lambda t: torch.stack([0.2 * t, 0.5 * torch.sin(40.0 * t), 0.3 + 0.0 * t])),
            mbd.SpringDamper(mbd.Ground().at(0.3, 0.0, 0.2), rod.at("right"), stiffness=30.0, damping=0.2, rest=0.1),
        ],
        gravity=GRAVITY,
    )


DRIVEN = [
    mbd.Phase(until=mbd.Event(lambda motion: tip(motion) - 0.132, "rising")),
    mbd.Phase(lasting=0.013, lock=["universal_arm_rod"]),
    mbd.Phase(lasting=0.011, lock=["revolute_ground_arm"], release=["motor"]),
    mbd.Phase(release=["motor"]),
]


@pytest.fixture(scope="module", params=["free", "driven"])
def motion(request, swing) -> Trajectory:
    """The design with sensitivities, and its neighbors one step and two steps up and down."""
    system, phases = (swing, PHASES) if request.param == "free" else (driven(), DRIVEN)
    b = dict(system.named_parameters())[NAME].detach()
    designs = {NAME: torch.stack([b + k * STEP * DIRECTION for k in (0.0, 1.0, -1.0, 2.0, -2.0)])}
    return mbd.simulate(
        system, 0.075, steps=42, gradients="forward", designs=designs, phases=phases, iterations=(16, 6)
    ).require_ok()


def differences(x: Tensor, steps: int = 1) -> Tensor:
    return (x[2 * steps - 1] - x[2 * steps]) / (2.0 * steps * STEP)


def agree(found: Tensor, expected: Tensor, tolerance: float) -> None:
    size = float((found.abs() @ DIRECTION).max())
    assert float((found @ DIRECTION - expected).abs().max()) < tolerance * size


# Differences of accelerations have the rounding errors of the constraints over the square of the step.
@pytest.mark.parametrize(("kind", "tolerance"), [("q", 2e-7), ("v", 2e-7), ("a", 1e-5)])
def test_motion_through_phases_against_differences(kind, tolerance, motion):
    agree(getattr(motion, f"d{kind}_db")[0], differences(getattr(motion, kind)), tolerance)


def test_switches_against_differences(motion):
    assert [switch.phase for switch in motion.switches] == ["2", "3", "4"]
    for switch in motion.switches:
        assert float(switch.dt_db[0].abs().min()) > 1e-5
        pairs = [(switch.t, switch.dt_db)]
        for side in (switch.before, switch.after):
            pairs += [(side.q, side.dq_db), (side.v, side.dv_db)]
        for x, dx in pairs:
            agree(dx[0], differences(x), 3e-7)


def test_integral_of_a_history_that_jumps_against_differences(motion):
    """The speed of the arm jumps where it is locked; the time of the jump moves with the design.

    The RMS of the driven arm is 7e4 times its slope: with one step rounding shows.
    """
    speed = mbd.history(lambda motion: motion.body("arm").omega[..., 0])
    for window in (None, (0.011, 0.0571)):
        measures = [kind(speed, window) for kind in (mbd.Integral, mbd.RMS)]
        for measure in (*measures, mbd.Integral(mbd.StrainEnergy("rod"), window)):
            result = measure.value_and_gradient(motion)
            agree(result.gradient[0], differences(result.value, 2), 1e-6)


def test_both_routes_agree_on_what_comes_after_a_switch(swing):
    """generalized_alpha is of second order in motion and sensitivities, through all switches."""
    asked = {"gradients": "forward", "phases": [PHASES[0], mbd.Phase(lock=["universal_arm_rod"])]}
    exact = mbd.simulate(swing, 0.06, "dopri5", steps=6, rtol=1e-7, atol=1e-9, **asked).require_ok()
    coarse, fine = (mbd.simulate(swing, 0.06, steps=steps, **asked).require_ok() for steps in (30, 60))
    for name in ("q", "dq_db"):
        errors = [
            float((getattr(result, name)[:, ::every] - getattr(exact, name))[:, -2:].abs().max())
            for result, every in ((coarse, 5), (fine, 10))
        ]
        assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
