"""The adjoint through locks, releases, events and impacts: against tangents, differences, closed forms; what it costs."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import finished, pendulum, tensor
from tests.refused import refused
from tests.sensitivity.test_events import (
    DOWN,
    DRIVEN,
    DURATION,
    NAME,
    PHASES,
    bounces,
    bouncing,
    driven,
    falling_mass,
    tip,
)
from torchmbd.design.differentiate import differentiate
from torchmbd.integrate import Trajectory
from torchmbd.integrate.phases.segment import segments_of
from torchmbd.multibody.equations import equations

pytestmark = pytest.mark.usefixtures("compiled")

TIGHT = {"iterations": (16, 6)}
WAYS = ("forward", "reverse")
ANGLES = tensor(0.35, -0.87)


def everything(motion: Trajectory) -> Tensor:
    """Numbers that depend on all of a motion, on all of its switches, and on the last time of these [lanes, 3]."""
    sides = [x for s in motion.switches for side in (s.before, s.after) for x in (side.q, side.v, side.a, side.lam)]
    sizes = 1.0, 0.1, 1e-3, 1e-3
    total = weighted([c * x for c, x in zip(sizes, (motion.q, motion.v, motion.a, motion.lam), strict=True)])
    sides = weighted([sizes[i % 4] * x for i, x in enumerate(sides)] + [s.t[:, None] for s in motion.switches])
    energy = mbd.Integral(mbd.StrainEnergy("rod"))(motion) + 1e-2 * motion.energies.balance[:, -1]
    return torch.stack([total, sides, motion.switches[-1].t + energy], 1)


def weighted(parts: list[Tensor]) -> Tensor:
    weights = [torch.sin(1.0 + torch.arange(x[0].numel(), dtype=x.dtype)).reshape(x.shape[1:]) for x in parts]
    return torch.stack([(w * x + (w * x) ** 2).flatten(1).sum(1) for w, x in zip(weights, parts, strict=True)]).sum(0)


def slowed(motion: Trajectory) -> Tensor:
    """A map of the velocities that fits the joints and depends on the place and on the design."""
    place = motion.body("rod").at("right").position[..., :1]
    return motion.v * (0.4 + place + 0.1 * motion.designs[NAME][:, None, :1])


def leaning(motion: Trajectory) -> Tensor:
    """A function of the motion and of the design itself."""
    return tip(motion) + 0.003 * torch.sin(motion.designs[NAME][:, :1])


def falling(impact: float | Callable | None = None) -> list[mbd.Phase]:
    return [mbd.Phase(until=mbd.Event(tip, "falling"), impact=impact), mbd.Phase()]


CASES = {
    "locks and a release": (lambda: pendulum(damping=1e-4), 0.075, 42, PHASES),
    "drive and forces": (driven, 0.075, 42, DRIVEN),
    "restitution": (lambda: pendulum(damping=1e-4), 0.06, 30, falling(0.4)),
    "a map of velocities": (lambda: pendulum(damping=1e-4), 0.06, 30, falling(slowed)),
    "an event of the design": (
        lambda: pendulum(damping=1e-4),
        0.06,
        30,
        [mbd.Phase(until=mbd.Event(leaning)), mbd.Phase(lock=["universal_arm_rod"])],
    ),
    "on the grid": (
        lambda: pendulum(damping=1e-4),
        0.06,
        30,
        [
            mbd.Phase(until=0.02, lock=["universal_arm_rod"]),
            mbd.Phase(lasting=0.003),
            mbd.Phase(until=0.05),
            mbd.Phase(),
        ],
    ),
}


def simulated(name: str, designs: Tensor, gradients: str, **options) -> Trajectory:
    make, duration, steps, phases = CASES[name]
    given: dict[str, Any] = {"steps": steps, "phases": phases, "designs": {NAME: designs}, **TIGHT, **options}
    return mbd.simulate(make(), duration, gradients=gradients, **given)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "method"), [*((name, "generalized_alpha") for name in CASES), ("restitution", "hht_alpha")]
)
def test_the_gradient_is_that_of_forward_tangents(name, method):
    """Lanes far apart, which switch between different points of the grid."""
    designs = torch.stack([ANGLES, ANGLES + tensor(0.5, 0.3)])
    forward, back = (finished(simulated(name, designs, way, method=method)) for way in WAYS)
    assert [motion.stats["gradients"] for motion in (forward, back)] == list(WAYS)
    expected, result = (differentiate(everything, motion) for motion in (forward, back))
    assert_close(result.value, expected.value, rtol=1e-12, atol=0)
    assert expected.gradient is not None
    assert result.gradient is not None
    size = expected.gradient.abs().amax((0, 2))
    assert float(size[:2].min()) > 0.0
    assert float(((result.gradient - expected.gradient).abs().amax((0, 2)) / size).max()) < 1e-8


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["a map of velocities", "an event of the design"])
def test_against_differences_of_the_same_discrete_map(name):
    """Richardson's extrapolation of central differences; of locks, drives and forces test_events.py has the tangents'."""
    way, step = tensor(1.0, 0.4), 1e-3
    around = torch.stack([ANGLES + c * step * way for c in (1, -1, 2, -2)])
    values = everything(finished(simulated(name, around, "none")))
    near, far = (values[0] - values[1]) / (2.0 * step), (values[2] - values[3]) / (4.0 * step)
    motion = finished(simulated(name, ANGLES[None], "reverse"))
    result = differentiate(everything, motion).gradient
    assert result is not None
    assert_close(result[0] @ way, (4.0 * near - far) / 3.0, rtol=1e-6, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("impact", [0.8, lambda motion: motion.v * tensor(1.0, 1.0, -0.8, 1.0, 1.0, 1.0)])
def test_a_bouncing_mass_has_the_gradients_of_its_closed_form(impact):
    """The variable has the name of the datum of the equations that it becomes, `gravity`."""
    fields = tensor(9.81, 7.0, 20.0)[:, None].requires_grad_()
    phases = [mbd.Phase(until=mbd.Event(mbd.Position("mass", axis="z"), "falling"), impact=impact)] * 2 + [mbd.Phase()]
    motion = mbd.simulate(
        falling_mass(), DURATION, steps=40, designs={"gravity": fields * DOWN}, phases=phases
    ).require_ok()
    assert motion.stats["gradients"] == "reverse"
    times = motion.switches[0].t + 2.0 * motion.switches[1].t
    (result,) = torch.autograd.grad(times.sum() + (motion.q[:, 1:, 2] * motion.t[1:]).sum(), fields)

    def exact(g: Tensor) -> Tensor:
        first, second = bounces(g)
        heights = torch.stack([bouncing(t, g)[0] for t in motion.t[1:]])
        return first + 2.0 * second + heights @ motion.t[1:]

    assert_close(
        result[:, 0], torch.stack([torch.func.grad(exact)(g) for g in fields.detach()[:, 0]]), rtol=1e-9, atol=0
    )


@pytest.mark.thorough
def test_a_lane_that_never_gets_there_adds_nothing():
    """The level lies between what the designs reach; what the other lane has is what it has alone."""
    designs = torch.stack([ANGLES, tensor(1.4, 0.2)])
    options = {"steps": 25, "designs": {NAME: designs}}
    heights = mbd.simulate(pendulum(damping=1e-4), 0.05, **options).body("rod").at("right").position[..., 2].amin(1)
    level = float(heights.detach().mean())
    event = mbd.Event(lambda motion: motion.body("rod").at("right").position[..., 2] - level)
    own = {"phases": [mbd.Phase(until=event), mbd.Phase()], "gradients": "reverse"}
    motion = mbd.simulate(pendulum(damping=1e-4), 0.05, **(options | own))
    there = int(heights.argmin())
    assert [status == "ok" for status in motion.status] == [lane == there for lane in (0, 1)]

    def numbers(motion: Trajectory) -> Tensor:
        return torch.stack([motion.q[:, -1].sum(-1), motion.switches[0].t], 1)

    result = differentiate(numbers, motion).gradient
    alone = mbd.simulate(pendulum(damping=1e-4), 0.05, steps=25, designs={NAME: designs[[there]]}, **own)
    expected = differentiate(numbers, alone.require_ok()).gradient
    assert result is not None
    assert expected is not None
    assert_close(result[there], expected[0], rtol=1e-9, atol=0)
    assert float(result[1 - there].abs().max()) == 0.0


def test_forces_of_a_phase_act_where_those_of_the_whole_do():
    """Locks attach vectors of their own, and move the places of those of the forces among all."""
    system = driven()
    whole, segments = segments_of(system, DRIVEN, 0.075)
    assert len(whole.topology.attached) > len(system.topology.attached)
    for segment in segments:
        for kind, own in zip(segment.topology.actions, whole.topology.actions, strict=True):
            assert [x.tolist() for x in kind.members] == [x.tolist() for x in own.members]


@pytest.mark.thorough
def test_native_and_eager_agree(native):
    designs = torch.stack([ANGLES, ANGLES + tensor(0.5, 0.3)])
    name = "restitution"
    result = [
        differentiate(everything, finished(simulated(name, designs, "reverse", backend=backend)))
        for backend in ("native", "eager")
    ]
    one, other = (x.gradient for x in result)
    assert one is not None
    assert other is not None
    assert float(((one - other).abs().amax((0, 2)) / other.abs().amax((0, 2))).max()) < 1e-8


@pytest.mark.thorough
def test_backward_reaches_the_parameters_and_a_motion_can_be_pickled():
    system = pendulum(damping=1e-4)
    motion = mbd.simulate(system, 0.06, steps=30, phases=falling(0.4)).require_ok()
    (motion.switches[0].t.sum() + motion.q[:, -1].sum()).backward()
    parameter = system.get_parameter(NAME)
    assert parameter.grad is not None
    assert float(parameter.grad.abs().min()) > 0.0
    again = pickle.loads(pickle.dumps(motion))
    assert_close(again.switches[0].t, motion.switches[0].t.detach(), rtol=0, atol=0)
    with refused("gradients", "reverse", "dq_db"):
        _ = motion.dq_db


@pytest.mark.thorough
def test_the_cost_does_not_know_how_many_variables_there_are(monkeypatch):
    """Evaluations of the equations for all parameters as for one, none of them with tangents by these.

    Their numbers may differ by some iterations: modes with and without derivatives are rounded differently.
    """
    placement, counts = equations.placement, []

    def counted(T, data, q, given):
        counts[-1].append(q.shape[-2])
        return placement(T, data, q, given)

    system = pendulum([20.0] * 4 + [-50.0] * 4, damping=1e-4)
    names = [name for name, _ in system.named_parameters()]
    monkeypatch.setattr(equations, "placement", counted)
    for variables in ([NAME], [NAME], names):  # the first looks at what modes leave out, and writes what is compiled
        counts.append([])
        options = {
            "steps": 30,
            "phases": falling(0.4),
            "gradients": "reverse",
            "variables": variables,
            "backend": "eager",
        }
        motion = mbd.simulate(system, 0.06, **options).require_ok()
        response = motion.switches[0].t.sum() + motion.q[:, -1].sum()
        result = torch.autograd.grad(response, list(motion.variables.values()), allow_unused=True)
        assert result[list(motion.variables).index(NAME)] is not None
    assert sum(x.numel() for x in motion.variables.values()) == 16
    # A tangent for each of 16 would be 16 times as many.
    assert len(counts[2]) == pytest.approx(len(counts[1]), rel=0.15)
    assert len(counts[1]) > 60
    assert max(counts[1]) <= 2  # the size of a last step, during its search, is the only tangent
