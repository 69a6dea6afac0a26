"""Motions through phases: lanes that are integrated again by smaller steps, steps that are made again from checkpoints."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.diagnosis.test_jumps import exact, held, turned
from tests.integrate.test_contacts import dropped, thrown
from tests.mechanisms import finished, tensor
from tests.sensitivity.test_phase_adjoint import ANGLES, CASES, simulated
from torchmbd.integrate import Trajectory

pytestmark = pytest.mark.usefixtures("compiled")

STIFFNESS = "floor.stiffness"
PHASES = [mbd.Phase(until=0.1), mbd.Phase()]


@pytest.mark.thorough
def test_a_contact_shorter_than_a_step_is_found_in_a_phase():
    """The apex of a throw after an elastic contact is that of the motion without phases, whose steps are as small."""
    options: dict[str, Any] = {"steps": 80, "gradients": "none"}
    motion = mbd.simulate(thrown(0.05), 0.9, phases=PHASES, **options).require_ok()
    plain = mbd.simulate(thrown(0.05), 0.9, **options).require_ok()
    assert motion.stats["halved"] == plain.stats["halved"] == [0]
    height = mbd.Max(mbd.Position("ball", "z"))
    assert_close(height(motion), height(plain), rtol=1e-6, atol=0)
    press = mbd.Min(mbd.Acceleration("ball", "z"))  # between the outputs
    assert float(press(plain)) < -20.0
    assert_close(press(motion), press(plain), rtol=1e-2, atol=0)
    energy = motion.energies
    assert float(energy.balance.abs().max()) < 1e-3 * float(energy.stored[:, 0].abs())


@pytest.mark.thorough
def test_lanes_get_what_they_need():
    """A lane that needs smaller steps has them alone, with its switch; the other keeps its motion."""
    system, phases = dropped(stiffness=mbd.variable(1e5)), [mbd.Phase(until=0.05), mbd.Phase()]
    stiffness = tensor(1e2, 1e5)
    options: dict[str, Any] = {"steps": 300, "phases": phases, "gradients": "none"}
    both = mbd.simulate(system, 0.28, designs={STIFFNESS: stiffness}, **options).require_ok()
    assert both.stats["halved"] == [1]
    for lane in range(2):
        alone = mbd.simulate(system, 0.28, designs={STIFFNESS: stiffness[lane : lane + 1]}, **options).require_ok()
        for x, y in ((both.q, alone.q), (both.lam, alone.lam), (both.switches[0].after.v, alone.switches[0].after.v)):
            assert_close(x[lane], y[0], rtol=0, atol=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["reverse", "forward"])
def test_derivatives_go_through_smaller_steps(gradients):
    """By the stiffness, of a batch in which one lane has the steps that were asked for; an event ends the first phase."""
    system = dropped(stiffness=mbd.variable(2e4), damping=0.1)
    rises = mbd.Event(lambda m: m.v[..., 2] - 0.2, "rising")

    def final(k: Tensor) -> Tensor:
        motion = mbd.simulate(
            system,
            0.25,
            steps=60,
            designs={STIFFNESS: k},
            gradients=gradients,
            iterations=(12, 6),
            phases=[mbd.Phase(until=rises), mbd.Phase()],
        ).require_ok()
        return motion.q[:, -1, 2] + motion.switches[0].t + mbd.Max(mbd.Position("ball", "z"))(motion)

    k = tensor(2e4, 3e4).requires_grad_()
    [slopes] = torch.autograd.grad(final(k).sum(), k)
    h = 0.02
    with torch.no_grad():  # in one batch: lanes with contacts have the same smaller steps
        around = torch.cat([k + c * h for c in (1, -1, 2, -2)]).requires_grad_()
        values = final(around).reshape(4, 2)
    near, far = (values[0] - values[1]) / (2.0 * h), (values[2] - values[3]) / (4.0 * h)
    assert_close(slopes, (4.0 * near - far) / 3.0, rtol=1e-6, atol=0)


@pytest.mark.thorough
def test_held_values_that_change_within_a_phase():
    """Steps of both phases are divided until some end where the values change."""
    phases = [mbd.Phase(until=0.55), mbd.Phase()]
    motion = mbd.simulate(held(1.0, -1.0, 2.0), 2.0, steps=20, phases=phases, gradients="none")
    assert motion.stats["halved"] == [0]
    plain = mbd.simulate(held(1.0, -1.0, 2.0), 2.0, steps=60, gradients="none")
    assert_close(turned(motion), turned(plain), rtol=1e-9, atol=0)
    assert_close(turned(motion)[0], exact(tensor(1.0, -1.0, 2.0)), rtol=1e-3, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "backend"), [*((name, "native") for name in CASES), ("locks and a release", "eager")])
def test_checkpoints_keep_fewer_states_of_the_same_motion(name, backend):
    """Values, and derivatives that read these states and the switches; lanes that switch in different intervals."""
    designs = torch.stack([ANGLES, ANGLES + tensor(0.5, 0.3)])

    def run(**options: int) -> tuple[Trajectory, Tensor]:
        x = designs.clone().requires_grad_()
        motion = finished(simulated(name, x, "reverse", backend=backend, **options))
        kept = slice(None, None, 1 if options else 6)
        sides = [y for s in motion.switches for y in (s.t[:, None], s.after.v, 1e-3 * s.before.lam)]
        parts = [motion.q[:, kept], motion.v[:, kept], 1e-3 * motion.lam[:, kept], *sides]
        weights = [torch.sin(1.0 + torch.arange(y[0].numel(), dtype=y.dtype)) for y in parts]
        total = torch.stack([(w * y.flatten(1)).sum() for w, y in zip(weights, parts, strict=True)]).sum()
        [slopes] = torch.autograd.grad(total, x)
        return motion, slopes

    (every, slopes), (few, slopes_of_few) = run(), run(checkpoint=6)
    assert len(few.t) == (len(every.t) - 1) // 6 + 1
    assert_close(few.q, every.q[:, ::6], rtol=0, atol=1e-9)
    assert_close(few.lam, every.lam[:, ::6], rtol=0, atol=1e-6 * float(every.lam.detach().abs().max()))
    assert_close(slopes_of_few, slopes, rtol=1e-6, atol=1e-7 * float(slopes.abs().max()))


@pytest.mark.thorough
def test_a_lane_that_fails_in_an_early_phase_leaves_statistics_and_gradients_of_the_others():
    """Its phase never ends, with smaller steps as well: it is not tried again. By the duration all outputs move at once."""
    system = dropped(stiffness=mbd.variable(2e3), damping=0.1, height=0.005)
    falls = mbd.Event(lambda m: m.v[..., 2] + 0.1, "rising")
    phases = [mbd.Phase(until=falls), mbd.Phase(until=0.045), mbd.Phase()]
    designs = {STIFFNESS: tensor(4e4, 2e3)}
    options: dict[str, Any] = {"steps": 60, "phases": phases, "backend": "eager", "halvings": 0}
    forward = mbd.simulate(system, 0.1, designs=designs, gradients="forward", variables=[STIFFNESS], **options)
    assert [status.startswith("failed") for status in forward.status] == [False, True]
    assert "renewed" not in forward.stats
    assert "tangent_error" in forward.stats

    def slope(k: Tensor) -> Tensor:
        T = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
        motion = mbd.simulate(system, T, designs={STIFFNESS: k}, **options)
        return torch.autograd.grad(motion.q[0, -1, 2], T)[0]

    assert_close(slope(designs[STIFFNESS]), slope(tensor(4e4)), rtol=1e-9, atol=0)
