"""Errors of responses by the steps: effectivity against eight times the steps, artifacts of steps, bad input."""

from __future__ import annotations

import math
import pickle

import pytest
import torch

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.diagnosis.response_error import response_error
from torchmbd.integrate import Trajectory

ANGLE = mbd.Final(mbd.Angle("bob", "z"))
ENERGY = mbd.StrainEnergy("arm")
TIP = mbd.Displacement("arm", "z", node="right")
OF_ARM = {
    "integral": mbd.Integral(ENERGY),
    "max": mbd.Max(ENERGY),
    "final": mbd.Final(TIP),
    "at_time": mbd.AtTime(mbd.Position("tool", "z"), 0.05),
    "rms": mbd.RMS(TIP),
    "operators": mbd.Max(ENERGY) / mbd.Integral(ENERGY) + 2.0 * mbd.Min(TIP),
    "peaks": mbd.AtPeaks(TIP, count=2),
}
if "fatigue" in mbd.__all__:  # the extension fatigue is there
    OF_ARM["load"] = mbd.fatigue.EquivalentLoad(TIP, exponent=4.0, cycles=1.0)


def oscillator(frequency: float = 40.0) -> mbd.System:
    """A mass of 1 kg on a spring, pushed at the start: x = v0/omega sin(omega t)."""
    bob = mbd.RigidBody("bob", 1.0, (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    ground = mbd.Ground()
    stiffness = (2.0 * math.pi * frequency) ** 2
    spring = mbd.SpringDamper(ground.at(-1.0, 0.0, 0.0), bob.at(), stiffness=stiffness, rest=1.0)
    return mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])


def effectivity(motion: Trajectory, exact: Trajectory, response: mbd.Measure) -> torch.Tensor:
    error = motion.error_of(response, modes=False, mesh=False)
    assert error.resolved.all(), str(error)
    return error.by_steps / (response(exact) - error.value)


@pytest.mark.thorough
def test_error_of_a_pendulum() -> None:
    system = mbd.examples.pendulum()
    motion, exact = (mbd.simulate(system, 0.5, steps=n, gradients="none") for n in (40, 320))
    assert 0.9 < effectivity(motion, exact, ANGLE).item() < 1.1
    assert 0.9 < effectivity(motion, exact, 2.0 * ANGLE + 1.0).item() < 1.1  # of an expression


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "hht_alpha"])
def test_effectivity_of_kinds_of_responses(method: str) -> None:
    system = mbd.examples.arm()
    motion, exact = (mbd.simulate(system, 0.1, method, steps=n, gradients="none") for n in (100, 800))
    for name, response in OF_ARM.items():
        shares = effectivity(motion, exact, response)
        assert ((shares > 0.5) & (shares < 2.0)).all(), (name, shares)


@pytest.mark.thorough
@pytest.mark.parametrize("frequency", [5.0, 10.0])
def test_effectivity_of_an_oscillator(frequency: float) -> None:
    system = oscillator(frequency)
    motion, exact = (mbd.simulate(system, 0.33, steps=n, gradients="none", backend="eager") for n in (100, 800))
    x = mbd.Position("bob", "x")
    for response in (mbd.Final(x), mbd.RMS(x), mbd.Integral(x), mbd.AtTime(x, 0.11)):
        assert 0.5 < effectivity(motion, exact, response).item() < 2.0, response


@pytest.mark.thorough
def test_error_of_an_adaptive_method() -> None:
    system = mbd.examples.pendulum()
    motion = mbd.simulate(system, 0.1, "dopri5", steps=4, gradients="none", rtol=1e-3, atol=1e-4)
    exact = mbd.simulate(system, 0.1, "dopri5", steps=4, gradients="none", rtol=1e-9, atol=1e-10)
    assert 0.5 < effectivity(motion, exact, ANGLE).item() < 2.0


@pytest.mark.thorough
def test_artifact_of_steps_is_not_resolved() -> None:
    """A free vibration with 1.6 steps a period: the position at the end is a number of the steps only."""
    motion = mbd.simulate(oscillator(), 1.003, steps=64, gradients="none", backend="eager")
    response = mbd.Final(mbd.Position("bob", "x"))
    error = motion.error_of(response)
    size = 1.0 / (2.0 * math.pi * 40.0)  # [m]
    assert not error.resolved.any() or error.by_steps.abs().item() > 0.1 * size
    assert ("not resolved" in str(error)) == (not error.resolved.item())


@pytest.mark.thorough
def test_lanes_have_errors_of_their_own() -> None:
    designs = {"arm.laminate.angles": mbd.deg(torch.tensor([[0.0, 90.0], [45.0, -45.0]], dtype=torch.float64))}
    motion = mbd.simulate(mbd.examples.arm(), 0.02, steps=40, designs=designs, gradients="none")
    error = motion.error_of(mbd.Integral(ENERGY))
    assert error.by_steps.shape == (2,)
    assert len(str(error).splitlines()) == 2
    single = mbd.simulate(
        mbd.examples.arm(), 0.02, steps=40, designs={k: x[1:] for k, x in designs.items()}, gradients="none"
    )
    torch.testing.assert_close(single.error_of(mbd.Integral(ENERGY)).by_steps, error.by_steps[1:], rtol=1e-6, atol=0.0)


@pytest.mark.thorough
def test_start_of_the_motion_is_kept() -> None:
    system, start = mbd.examples.pendulum(), {"bob.velocity": [0.3, 0.0, 0.0]}
    motion, exact = (mbd.simulate(system, 0.5, steps=n, start=start, gradients="none") for n in (40, 320))
    assert 0.9 < effectivity(motion, exact, ANGLE).item() < 1.1


@pytest.mark.thorough
def test_errors_of_a_problem() -> None:
    problem = mbd.Problem(
        mbd.examples.arm(),
        0.02,
        maximize=mbd.Integral(ENERGY),
        steps=40,
        subject_to=[mbd.Max(TIP) <= "initial"],
    )
    objective, constraint = problem.errors(problem.start)
    motion = problem.motion(problem.start)
    assert torch.equal(objective.value, mbd.Integral(ENERGY)(motion))
    assert torch.equal(constraint.by_steps, motion.error_of(mbd.Max(TIP)).by_steps)
    assert "peak" in constraint.note
    assert not objective.note
    assert objective.by_steps.isfinite().all()


@pytest.mark.thorough
def test_bad_input() -> None:
    system = mbd.examples.pendulum()
    motion = mbd.simulate(system, 0.1, steps=10, gradients="none")
    with refused("response", ANY, "such as mbd"):
        motion.error_of(mbd.Angle("bob", "z"))
    with refused("response", 3):
        response_error(motion, 3)  # pyright: ignore[reportArgumentType]
    with refused("method", "rk4"):
        mbd.simulate(system, 0.1, "rk4", steps=10, gradients="none").error_of(ANGLE)
    with refused("motion"):
        pickle.loads(pickle.dumps(motion)).error_of(ANGLE)


def test_changed_parameter_is_refused() -> None:
    system = mbd.examples.arm()
    motion = mbd.simulate(system, 0.01, steps=4, gradients="none")
    with torch.no_grad():
        dict(system.named_parameters())["arm.laminate.angles"].add_(0.1)
    with refused("arm.laminate.angles"):
        motion.error_of(mbd.Integral(ENERGY))


@pytest.mark.thorough
@pytest.mark.parametrize("origin", [0.0, 1e3])
def test_the_range_of_a_constant_is_rounding_and_not_a_size(origin: float) -> None:
    """A bent strip at rest: the height of its tip has the same number at all times, up to rounding."""
    ply = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6)
    options = {"modes": 2, "reference": "left_edge", "expansion": True}
    laminate = mbd.Laminate(ply, mbd.deg([20, -50]), 0.25e-3, symmetric=True)
    strip = mbd.FlexibleBody.plate("strip", mbd.mesh.rectangle(0.4, 0.1, (6, 2)), laminate, **options)
    warm = mbd.Temperature(strip, 40.0, gradient=2e4)
    hold = mbd.Fixed(mbd.Ground().at(-0.2, 0, 0), strip.at("left"))
    system = mbd.System([strip], [hold], [warm], truncation=None)
    motion = mbd.simulate(system, 0.1, steps=40, start="equilibrium", gradients="none")
    height = mbd.Max(abs(mbd.Position("strip", "z", node="right") - origin))
    error = motion.error_of(height, modes=False, mesh=False)
    assert error.resolved.all(), str(error)
    assert (error.by_steps.abs() <= 1e-3 * error.size).all()
