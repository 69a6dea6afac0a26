"""Steps where the caller does not say how many: enough for what moves, not for modes that nothing excites."""

from __future__ import annotations

import math

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import box, tensor
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrator import IntegrationResult
from torchmbd.integrate.statistics import Statistics
from torchmbd.integrate.step_count import all_modes, first_steps, needed_steps
from torchmbd.multibody.equations.sizes import Sizes
from torchmbd.results.history import History

pytestmark = pytest.mark.usefixtures("compiled")  # thousands of steps
GROUND = mbd.Ground()
ROD = mbd.GivenSection.isotropic(E=2.1e11, nu=0.3, density=7800.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)


def arm(angle=None, push=None, **options) -> mbd.System:
    """A beam on a driven hinge, or on a wall with a load at its end; its interface modes are stiff."""
    options = {"reduction": "craig-bampton", "interface": ["end"], "modes": 2} | options
    body = mbd.FlexibleBody.beam("bar", mbd.BeamLine.straight(1.0, 6), ROD, reference="start", **options)
    if angle is None:
        joints = [mbd.Fixed(GROUND.at(), body.at("start"))]
    else:
        hinge = GROUND.at(), body.at("start")
        joints = [mbd.Revolute(*hinge, axis="z", name="hinge"), mbd.Drive(*hinge, axis="z", angle=angle, name="motor")]
    return mbd.System([body], joints, [] if push is None else [mbd.Force(body.at("end"), push, name="push")])


def error(system: mbd.System, duration: float, finer: int = 8) -> tuple[int, float]:
    """Steps by default, and the largest error of the tip's displacement beside many more, of its largest."""
    tip = mbd.Displacement("bar", "y", node="end")
    with torch.no_grad():
        motion = mbd.simulate(system, duration).require_ok()
        steps = motion.stats["steps"]
        a, b = tip(motion)[0], tip(mbd.simulate(system, duration, steps=finer * steps))[0, ::finer]
    return steps, float((a - b).abs().max() / b.abs().max())


@pytest.mark.thorough
def test_modes_that_nothing_excites_cost_nothing():
    system = arm(mbd.SmoothStep(1.0, 0.8))
    steps, off = error(system, 1.0)
    assert all_modes(system.dynamics(), 1.0) > 20_000
    assert steps < 1000
    assert off < 0.02


@pytest.mark.thorough
@pytest.mark.parametrize("frequency", [3.0, 20.0])
def test_a_drive_is_followed(frequency):
    system = arm(mbd.Sine(0.02, 2 * math.pi * frequency))
    steps, off = error(system, 0.5)
    assert 20 * frequency * 0.5 < steps < all_modes(system.dynamics(), 0.5) / 5
    assert off < 0.02


def pulse(t: torch.Tensor) -> torch.Tensor:
    """Of 4 ms in 4 s, which 200 steps would jump over."""
    y = torch.exp(-(((t - 1.2345) / 2e-3) ** 2))
    return torch.stack([0.0 * y, 10.0 * y, 0.0 * y])


@pytest.mark.thorough
def test_a_short_load_is_seen():
    short, constant = (
        InitialValueProblem.of_dynamics(arm(push=push, modes=0).dynamics(), 4.0) for push in (pulse, [0.0, 10.0, 0.0])
    )
    assert first_steps(short) >= 1024
    assert first_steps(constant) == 200


@pytest.mark.thorough
def test_what_starts_in_a_high_mode_is_resolved():
    """Every mode moves: as many steps as the fastest that does so asks for."""
    body = mbd.FlexibleBody.beam("bar", mbd.BeamLine.straight(1.0, 6), ROD, modes=6, reference="start")
    system = mbd.System([body.bent(None, [0.0] * 4 + [1e-2, 0.0])], [mbd.Fixed(GROUND.at(), body.at("start"))])
    with torch.no_grad():
        motion = mbd.simulate(system, 0.02).require_ok()
        energy = mbd.StrainEnergy("bar")(motion)[0]
    assert float(energy.max()) == pytest.approx(0.5 * 1e-4, rel=0.02)
    assert motion.stats["steps"] > 15 * 0.02 * float(mbd.equilibrium(system).vibrations[0].frequencies[4])


def stats(turn: float, error: float, suggested: float) -> Statistics:
    return Statistics(turn=tensor(turn), step_error=tensor(error), suggested_steps=tensor(suggested))


@pytest.mark.parametrize(
    ("found", "status", "wanted"),
    [
        (stats(0.1, 1e-5, 30.0), "ok", 200),
        (stats(0.1, 4e-2, 400.0), "ok", 1600),  # at most 8 times as many
        (stats(0.1, 4e-3, 120.0), "ok", 528),
        (stats(math.nan, math.nan, math.nan), "failed: the motion is not finite from t = 0.1 s on", 800),
    ],
)
def test_steps_that_an_estimate_asks_for(found, status, wanted):
    nothing = torch.zeros(1, 0, 1, 1, dtype=torch.float64)
    result = IntegrationResult(History(nothing, nothing, nothing, nothing), found, Sizes(nothing, nothing, nothing))
    assert needed_steps(200, result, [status], {}) == wanted
    assert needed_steps(200, result, [status], {0: "it starts nowhere"}) == 200


@pytest.mark.thorough
def test_phases_choose_alike():
    """The release shakes the bar."""
    system = arm(mbd.SmoothStep(0.1, 0.08))
    phases = [mbd.Phase(until=0.1), mbd.Phase(release=["motor"])]
    motion = mbd.simulate(system, 0.2, phases=phases, gradients="none").require_ok()
    assert 200 < motion.integration.steps <= all_modes(system.dynamics(), 0.2)


@pytest.mark.parametrize("start", ["assembled", "equilibrium"])
@pytest.mark.parametrize("turn", [0.0, 0.5 * math.pi])
@pytest.mark.parametrize("first", [True, False])
def test_joints_of_later_phases_and_locks_do_not_close_the_start(start: str, turn: float, first: bool) -> None:
    """A pendulum on a spring is held where it is, in the first phase or in the second, however it was turned at the start."""
    c, s = math.cos(turn), math.sin(turn)
    bob = mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01), center=(0.5, 0, 0), axes=[[c, -s, 0], [s, c, 0], [0, 0, 1]])
    joints = [mbd.Revolute(GROUND.at(), bob.at(), axis="z", name="hinge")]
    spring = mbd.RotationalSpringDamper(GROUND.at(), bob.at(), axis="z", stiffness=9.0, rest=turn - 0.3)
    system = mbd.System([bob], joints, [spring], gravity=(0.0, 0.0, -9.81))
    held, free = {"lock": ["hinge"]}, {}
    phases = [mbd.Phase(until=0.2, **(held if first else free)), mbd.Phase(**(free if first else held))]
    options = {"phases": phases, "start": start, "gradients": "none"}
    angle = mbd.Final(mbd.Angle("bob", "z"))
    value, given = (angle(mbd.simulate(system, 0.3, steps=n, **options).require_ok()) for n in (None, 1000))
    assert float(value) == pytest.approx(float(given), abs=1e-6)


@pytest.mark.thorough
def test_a_problem_keeps_the_steps_of_its_initial_design():
    """Alone, a short bar takes more than a long one; a batch has those of its fastest."""
    ball = box("ball", mass=mbd.variable(0.7))
    bar = mbd.FlexibleBody.beam("bar", mbd.BeamLine.straight(mbd.variable(1.0), 4), ROD, modes=2, reference="start")
    joints = [mbd.Fixed(GROUND.at(), bar.at("start")), mbd.Fixed(bar.at("end"), ball.at())]
    system = mbd.System([bar, ball], joints, gravity=(0.0, -9.81, 0.0))
    one, two, both = (
        mbd.simulate(system, 0.5, designs={"bar.line.length": tensor(*x)}, gradients="none").stats["steps"]
        for x in ((1.0,), (0.2,), (0.2, 1.0))
    )
    assert one < two == both
    problem = mbd.Problem(
        system, 0.5, mbd.Max(mbd.StrainEnergy("bar")), variables=["bar.line.length"], bounds=(0.2, 2.0)
    )
    assert problem.steps == one
    assert problem.motion(0.2 * problem.start).stats["steps"] == one
    lengths = [{"bar.line.length": 1.0}, {"bar.line.length": 0.2}]
    many = mbd.Scenarios(
        system, 0.5, mbd.Max(mbd.StrainEnergy("bar")), scenarios=lengths, variables=["ball.mass"], bounds=(0.1, 2.0)
    )
    assert many.steps == two
    assert many.motions(2.0 * many.start).stats["steps"] == two


def oscillator(frequency: float, damping: float = 0.0) -> mbd.System:
    """1 kg on a spring, at rest 1 mm from its equilibrium."""
    w = 2.0 * math.pi * frequency
    mass = mbd.RigidBody("mass", 1.0, (0.01, 0.01, 0.01))
    ends = GROUND.at(), mass.at()
    spring = mbd.AxialSpringDamper(*ends, axis="x", stiffness=w**2, damping=2.0 * damping * w)
    force = mbd.Force(mass.at(), (1e-3 * w**2, 0.0, 0.0))
    return mbd.System([mass], [mbd.Prismatic(*ends, axis="x")], [spring, force])


@pytest.mark.parametrize(("damping", "more"), [(0.0, True), (0.2, False)])
def test_vibrations_of_rigid_bodies_keep_their_phase(damping, more):
    """Displacements of 20 periods against the closed form. A vibration that decays within a few periods needs no more steps."""
    motion = mbd.simulate(oscillator(20.0, damping), 1.0, gradients="none")
    w, t = 40.0 * math.pi, motion.t
    w_d = w * math.sqrt(1.0 - damping**2)
    decay = torch.exp(-damping * w * t) * ((w_d * t).cos() + damping * w / w_d * (w_d * t).sin())
    expected = 1e-3 * (1.0 - decay)
    assert float((motion.body("mass").r[0, :, 0] - expected).abs().max()) < 0.05e-3
    assert (motion.stats["steps"] > 1000) == more


def test_a_phase_that_the_most_steps_do_not_keep_is_told(monkeypatch):
    monkeypatch.setattr("torchmbd.integrate.step_count._MOST_RIGID", 1000)
    with pytest.warns(UserWarning, match=r"1000 steps are the most.*late: by 0\.7 rad.*Try: method='rk4'.*or steps="):
        mbd.simulate(oscillator(40.0), 1.0, gradients="none")


def test_the_method_that_the_warning_names_keeps_the_phase():
    """In the same steps; no spectral radius of generalized-alpha does."""
    system, w = oscillator(40.0), 80.0 * math.pi

    def error(**options) -> float:
        motion = mbd.simulate(system, 1.0, steps=1000, gradients="none", **options)
        return float((1e3 * motion.body("mass").r[0, :, 0] - 1.0 + (w * motion.t).cos()).abs().max())

    assert error(method="rk4") < 0.02
    assert all(error(spectral_radius=radius) > 0.9 for radius in (0.5, 1.0))
