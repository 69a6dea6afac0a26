"""A motion in pieces is the motion in one: also accelerations, multipliers and reactions, which other starts let alternate."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import SOFT, laminate, plate, rigid_pendulum
from tests.sensitivity.number_cases import hung
from torchmbd.examples import slider_crank
from torchmbd.integrate.generalized_alpha import GeneralizedAlpha
from torchmbd.integrate.prepared import initial
from torchmbd.integrate.smooth_start import smooth_start

METHODS = ["generalized_alpha", "hht_alpha"]
G, MASS, LENGTH = 9.81, 2.0, 1.0


def numbers(motion: mbd.Trajectory) -> list[Tensor]:
    """Coordinates, rates, accelerations, multipliers and the force of the first joint."""
    motion.require_ok()
    return [motion.q, motion.v, motion.a, motion.lam, motion.reaction(motion.system.joints[0].name).force]


def cut(system: mbd.System, duration: float, steps: int, until: float | None, **options: Any) -> list[Tensor]:
    """Numbers of a motion that a phase without effect cuts at a time; None: in one piece."""
    phases = None if until is None else [mbd.Phase(until=until), mbd.Phase()]
    return numbers(mbd.simulate(system, duration, steps=steps, phases=phases, gradients="none", **options))


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("backend", ["eager", "native"])
@pytest.mark.usefixtures("compiled")
def test_a_cut_at_a_step_changes_nothing(method, backend):
    """To what the iterations of a step leave; accelerations are h^-2 times the rounding of positions."""
    for system, duration in ((rigid_pendulum(), 0.3), (slider_crank.build(2, cells=(4, 2), modes=2), 0.03)):
        options = {"method": method, "backend": backend}
        for x, y in zip(*(cut(system, duration, 60, t, **options) for t in (0.5 * duration, None)), strict=True):
            assert_close(x, y, rtol=0, atol=1e-7 * float(y.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("share", [0.02, 0.3, 0.98])
def test_a_cut_between_two_steps_is_less_than_their_error(method, share):
    """And of its order: a fourth with half the steps."""
    system, duration, differences, errors = rigid_pendulum(), 0.4, [], []
    finer = cut(system, duration, 800, None, method=method)
    for steps, every in ((200, 4), (400, 2)):
        plain = cut(system, duration, steps, None, method=method)
        pieces = cut(system, duration, steps, duration * (0.5 + share / steps), method=method)
        sizes = [float(x.abs().max()) for x in plain]
        differences.append([float((x - y).abs().max()) / c for x, y, c in zip(pieces, plain, sizes, strict=True)])
        errors.append([float((x - y[:, ::every]).abs().max()) / c for x, y, c in zip(plain, finer, sizes, strict=True)])
    for coarse, fine, error in zip(*differences, errors[1], strict=True):
        assert fine < 0.3 * error
        assert fine < 0.35 * coarse


def pendulum(speed: float = 0.0) -> mbd.System:
    """A mass on a hinge, started aside, with a speed across the rod."""
    spin = -speed / LENGTH
    bob = mbd.RigidBody(
        "bob", MASS, (1e-9, 1e-9, 1e-9), position=(LENGTH, 0, 0), velocity=(0, 0, speed), angular_velocity=(0, spin, 0)
    )
    hinge = mbd.Revolute(mbd.Ground().at(), bob.at(-LENGTH, 0, 0), axis="y", name="hinge")
    return mbd.System([bob], [hinge], gravity=(0.0, 0.0, -G))


def angle(motion: mbd.Trajectory) -> Tensor:
    """How far the rod is from a wall at 40 degrees below the horizon."""
    r = motion.body("bob").at().position
    return torch.atan2(r[..., 2], r[..., 0]) + 0.7


def pull_error(motion: mbd.Trajectory, after: float) -> float:
    """Largest error of the pull along the rod in the 20 steps after a time, of what its own positions and rates ask for."""
    view = motion.require_ok().body("bob").at()
    r, v = view.position, view.velocity
    radial = r / r.norm(dim=-1, keepdim=True)
    pull = MASS * ((v * v).sum(-1) / LENGTH - G * radial[..., 2])
    force = (motion.reaction("hinge").force.norm(dim=-1) - pull.abs())[0].abs()
    first = int((motion.t <= after + 1e-9).sum())
    return float(force[first : first + 20].max())


PIECES = {
    "nothing changes": [mbd.Phase(until=0.3037), mbd.Phase()],
    "a lock opens at a step": [mbd.Phase(until=0.3, lock=["hinge"]), mbd.Phase()],
    "a lock opens between two steps": [mbd.Phase(until=0.3037, lock=["hinge"]), mbd.Phase()],
    "an impact": [mbd.Phase(until=mbd.Event(angle, "falling"), impact=0.6), mbd.Phase()],
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("pieces", PIECES)
def test_multipliers_are_of_second_order_after_a_switch(method, pieces):
    """The pull of the hinge is that of the positions and rates of the motion, to an error that a quarter of the step makes a
    sixteenth."""
    errors = []
    for steps in (100, 400):
        motion = mbd.simulate(pendulum(), 1.0, method, steps=steps, phases=PIECES[pieces], gradients="none")
        errors.append(pull_error(motion, float(motion.switches[0].t)))
    assert errors[1] < 0.1 * errors[0]  # a quarter where multipliers are of first order


@pytest.mark.parametrize("method", METHODS)
def test_multipliers_are_of_second_order_from_the_start(method):
    """The same pull, in the first 20 steps of a motion that begins with a speed; the motion itself begins with just that."""
    errors = []
    for steps in (100, 400):
        motion = mbd.simulate(pendulum(speed=4.0), 0.3, method, steps=steps, gradients="none")
        errors.append(pull_error(motion, 0.0))
        velocity = motion.body("bob").at().velocity[0, 0].tolist()
        assert velocity == pytest.approx([0.0, 0.0, 4.0], abs=1e-13)
    assert errors[1] < 0.1 * errors[0]  # a quarter where multipliers are of first order


@pytest.mark.thorough
@pytest.mark.parametrize("checkpoint", [None, 20])
@pytest.mark.parametrize("backend", ["eager", "native"])
@pytest.mark.usefixtures("compiled")
def test_gradients_through_the_start_of_the_steps(backend, checkpoint):
    """By initial rates, which are outputs themselves: forward = reverse = differences."""
    system = slider_crank.build(2, cells=(4, 2), modes=2)
    name = "rod.laminate.angles"
    start = dict(system.named_parameters())[name].detach()

    def total(x: Tensor, gradients: str) -> Tensor:
        options: dict[str, Any] = {"gradients": gradients, "backend": backend}
        if checkpoint is not None:
            options["checkpoint"] = checkpoint
        motion = mbd.simulate(system, 0.02, steps=40, designs={name: x}, **options).require_ok()
        return 1e-3 * motion.v[:, 0].square().sum() + 1e-6 * motion.reaction(system.joints[0].name).force.square().sum()

    slopes = []
    for gradients in ("reverse",) if checkpoint else ("reverse", "forward"):
        x = start[None].clone().requires_grad_()
        slopes.append(torch.autograd.grad(total(x, gradients), x)[0])
    assert_close(slopes[-1], slopes[0], rtol=0, atol=1e-5 * float(slopes[0].abs().max()))
    step = 1e-4 * torch.ones_like(start)
    difference = float(total((start + step)[None], "none") - total((start - step)[None], "none"))
    assert difference == pytest.approx(2.0 * float((slopes[0] * step).sum()), rel=1e-4)


def test_a_body_at_rest_has_no_jerk_whatever_vibrates():
    """Bent, let go: h^2 v' is beyond all lengths, and the third rates of the hinge vanish, as they are linear in v'."""
    body = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), reduction="craig-bampton", interface="right")
    body = body.bent(1e-3 * torch.cos(torch.arange(body.modes, dtype=torch.float64)))
    dynamics = hung(body).dynamics().values()
    state, solver = initial(dynamics)
    t, h = torch.zeros(1, 1, dtype=torch.float64), torch.full((1, 1), 3e-3, dtype=torch.float64)
    start = smooth_start(dynamics, GeneralizedAlpha().weights(1.0), state, t, h, solver)
    largest = float(state.vd.abs().max())
    assert 0.5 * 3e-3**2 * largest > 0.2  # of a modal coordinate in a step
    assert 3e-3 * float(start.jerk.abs().max()) < 1e-9 * largest
    assert float(start.offset.abs().max()) < 1e-6 * largest
