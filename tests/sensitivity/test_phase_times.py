"""Gradients by the times at which phases end, `until` and `lasting`, and by the duration, through three phases."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import pendulum, tensor
from tests.refused import refused

LOCKED = "revolute_ground_arm"
TIMES = tensor(0.0213, 0.0171)  # between points of the grid, whose step is 0.0025 s
CAREFUL = {"iterations": (10, 10), "refresh": 0}


def phases(times: torch.Tensor) -> list[mbd.Phase]:
    return [mbd.Phase(until=times[0]), mbd.Phase(lasting=times[1], lock=[LOCKED]), mbd.Phase()]


def numbers(system: mbd.System, times: torch.Tensor, duration: Any = 0.075, **options) -> torch.Tensor:
    """Numbers of the motion, its switches and its reactions, with weights that tell them apart."""
    motion = mbd.simulate(system, duration, steps=30, phases=phases(times), **{**CAREFUL, **options})
    first, second = motion.switches
    parts = [
        motion.q,
        1e-2 * motion.v,
        first.t,
        second.t,
        second.before.q,
        1e-3 * second.before.lam,
        1e-2 * second.after.v,
    ]
    weights = torch.cos(torch.arange(sum(x.numel() for x in parts), dtype=torch.float64))
    return torch.cat([x.flatten() for x in parts]) @ weights


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return pendulum(damping=1e-4)


def gradient(system: mbd.System, **options) -> torch.Tensor:
    times = TIMES.clone().requires_grad_()
    return torch.autograd.grad(numbers(system, times, **options), [times])[0]


def richardson(system: mbd.System, k: int, h: float) -> float:
    def difference(h: float) -> torch.Tensor:
        step = h * torch.eye(2, dtype=torch.float64)[k]
        return (numbers(system, TIMES + step) - numbers(system, TIMES - step)) / (2.0 * h)

    with torch.no_grad():
        return float((4.0 * difference(h) - difference(2.0 * h)) / 3.0)


@pytest.mark.thorough
def test_the_gradient_is_that_of_differences(system):
    by_times = gradient(system)
    differences = torch.tensor([richardson(system, k, 2e-5) for k in range(2)], dtype=torch.float64)
    torch.testing.assert_close(by_times, differences, rtol=1e-6, atol=0.0)


@pytest.mark.thorough
def test_forward_mode_is_reverse_mode(system):
    tangents = [
        torch.func.jvp(lambda t: numbers(system, t), (TIMES,), (step,))[1] for step in torch.eye(2, dtype=torch.float64)
    ]
    torch.testing.assert_close(torch.stack(tangents), gradient(system), rtol=1e-9, atol=0.0)


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled")
def test_native_gradients_are_eager_ones(system):
    torch.testing.assert_close(
        gradient(system, backend="native"), gradient(system, backend="eager"), rtol=1e-9, atol=0.0
    )


@pytest.mark.thorough
def test_the_time_of_a_switch_is_the_tensor():
    bob = mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01), position=(0, 0, -1))
    hook = mbd.Fixed(mbd.Ground().at(0, 0, -1), bob.at(), name="hook")
    system = mbd.System([bob], [hook], gravity=(0, 0, -9.81))
    t = tensor(0.1).squeeze().requires_grad_()
    motion = mbd.simulate(system, 0.3, steps=30, phases=[mbd.Phase(until=t), mbd.Phase(release=["hook"])])
    (slope,) = torch.autograd.grad(motion.switches[0].t.sum(), [t], retain_graph=True)
    assert float(slope) == pytest.approx(1.0, rel=1e-14)
    fallen = mbd.Final(mbd.Position("bob", "z"))(motion)  # -1 - g (T - t)^2 / 2
    assert float(torch.autograd.grad(fallen.sum(), [t])[0]) == pytest.approx(9.81 * 0.2, rel=1e-9)


@pytest.mark.parametrize("options", [{"gradients": "forward", "variables": ["rod.laminate.angles"]}, {"method": "rk4"}])
def test_modes_that_do_not_reach_a_time_refuse_it_by_name(system, options):
    times = TIMES.clone().requires_grad_()
    with refused("1.until"):
        mbd.simulate(system, 0.075, steps=30, phases=phases(times), **options)


@pytest.mark.thorough
def test_values_alone_have_no_gradient_by_a_time(system):
    times = TIMES.clone().requires_grad_()
    assert not mbd.simulate(system, 0.075, steps=30, phases=phases(times), gradients="none").q.requires_grad
    with refused("1.until"):
        torch.func.jvp(lambda t: numbers(system, t, gradients="none"), (TIMES,), (torch.ones(2, dtype=torch.float64),))


@pytest.mark.parametrize("until", [tensor(0.1, 0.2), torch.tensor(0.1, dtype=torch.float32), tensor(-1.0).squeeze()])
def test_a_time_is_one_positive_float64_number(until):
    with refused("until"):
        mbd.Phase(until=until)


@pytest.fixture(scope="module", params=["free", "driven"])
def mechanism(request) -> mbd.System:
    """Where it is driven, a body of known motion and a force of time move with the grid."""
    return pendulum(damping=1e-4) if request.param == "free" else crank()


def crank() -> mbd.System:
    free = pendulum(damping=1e-4)
    arm, rod = free.body("arm"), free.body("rod")
    hinge = free.joints[0]
    motor = mbd.Drive(hinge.a, arm, axis="x", angle=lambda t: 0.2 * torch.sin(30.0 * t), name="motor")
    pull = mbd.Force(rod.at("right"), lambda t: torch.stack([0.2 * t, 0.5 * torch.sin(40.0 * t), 0.3 + 0.0 * t]))
    return mbd.System([arm, rod], [*free.joints, motor], [pull], gravity=(0.0, 0.0, -9.81))


def through(system: mbd.System, duration: Any) -> torch.Tensor:
    parts = [mbd.Phase(until=0.0213), mbd.Phase(lasting=0.0171, lock=["universal_arm_rod"]), mbd.Phase()]
    motion = mbd.simulate(system, duration, steps=30, phases=parts, **CAREFUL)
    last = motion.switches[1]
    numbers = [
        motion.q,
        1e-2 * motion.v,
        1e-4 * motion.a,
        1e-3 * motion.lam,
        last.t,
        last.before.q,
        1e-3 * last.before.lam,
    ]
    weights = torch.cos(torch.arange(sum(x.numel() for x in numbers), dtype=torch.float64))
    return torch.cat([x.flatten() for x in numbers]) @ weights


@pytest.mark.thorough
def test_the_gradient_by_the_duration_is_that_of_differences(mechanism):
    T = tensor(0.0752).squeeze()
    leaf = T.clone().requires_grad_()
    (slope,) = torch.autograd.grad(through(mechanism, leaf), [leaf])

    def difference(h: float) -> torch.Tensor:
        return (through(mechanism, float(T) + h) - through(mechanism, float(T) - h)) / (2.0 * h)

    with torch.no_grad():
        differences = (4.0 * difference(2e-5) - difference(4e-5)) / 3.0
    torch.testing.assert_close(slope, differences, rtol=1e-6, atol=0.0)
    _, tangent = torch.func.jvp(lambda t: through(mechanism, t), (T,), (torch.ones_like(T),))
    torch.testing.assert_close(tangent, slope, rtol=1e-9, atol=0.0)
