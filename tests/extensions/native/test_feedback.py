"""Controllers and laws that native code calls back: the same motions, tangents and gradients as by operators of torch."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, tensor
from tests.multibody.forces.test_controller import GROUND, OPTIONS, S, Steep, arm, hinged, linear, looked_at, network
from torchmbd.errors import InputError
from torchmbd.multibody.forces.laws import Scaled

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")


def branching(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    return -30.0 * s - 0.2 * rate if float(t) < 0.01 else -60.0 * s - 0.2 * rate


class Stated:
    """Its operators are not known to native code, and it states its slopes."""

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return -self._stiffness(s) * s - 0.3 * rate

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        return -self._stiffness(s), torch.full_like(s, -0.3)

    @staticmethod
    def _stiffness(s: Tensor) -> Tensor:
        return tensor(30.0, 60.0)[(s > -0.26).long()]


def sprung(law: Any) -> mbd.System:
    """Beside the law a controller, and a spring that is written out."""
    body, joint = hinged()
    spring = mbd.RotationalSpringDamper(joint.a, body.at(), "x", law=law)
    other = mbd.AxialSpringDamper(GROUND.at(), body.at(0.1, 0.0, 0.05), "y", stiffness=20.0, damping=0.1)
    inputs, outputs = [S.JointRate(joint), S.JointAngle(joint)], [S.JointTorque(joint)]
    control = mbd.Controller(linear((-0.2, 1.0), bias=0.1), inputs, outputs)
    return mbd.System([body], [joint], [spring, other, control], gravity=GRAVITY)


SYSTEMS = {
    "network": arm,
    "branch in Python": lambda: sprung(branching),
    "slopes stated": lambda: sprung(Stated()),
    "factor": lambda: sprung(Scaled(0.5, branching)),
}


@pytest.mark.thorough
@pytest.mark.parametrize("lanes", [1, 10])
@pytest.mark.parametrize("name", SYSTEMS)
def test_eager_and_native_agree(native: None, name: str, lanes: int) -> None:
    system = SYSTEMS[name]()
    names = [key for key, p in system.named_parameters() if p.requires_grad and key.startswith("controller")]
    own = {key: system.get_parameter(key).detach() for key in names}
    make = torch.Generator().manual_seed(7)
    designs = {key: x + 0.1 * torch.randn(lanes, *x.shape, generator=make, dtype=x.dtype) for key, x in own.items()}
    result = {}
    for backend in ("eager", "native"):
        motions = []
        for way in ("reverse", "forward"):
            given = {key: x.clone().requires_grad_() for key, x in designs.items()}
            motion = mbd.simulate(system, 0.02, designs=given, gradients=way, backend=backend, steps=8)
            assert motion.stats["backend"] == backend
            y = motion.q * (1.0 + motion.q) + 1e-2 * motion.v.sum(2, keepdim=True)
            motions += [motion.q.detach(), *torch.autograd.grad(y.sum(), list(given.values()))]
        result[backend] = motions
    for x, expected in zip(result["native"], result["eager"], strict=True):
        assert_close(x, expected, rtol=0, atol=1e-10 * float(expected.abs().max()))


@pytest.mark.thorough
def test_right_hand_sides_of_torchdiffeq(native: None) -> None:
    system = arm(network(9, 2))
    name = "controller.2.bias"
    result = []
    for backend in ("eager", "native"):
        x = system.get_parameter(name).detach().clone().requires_grad_()
        motion = mbd.simulate(
            system, 0.004, "rk4", steps=20, designs={name: x}, gradients="forward", backend=backend
        ).require_ok()
        assert motion.stats["backend"] == backend
        result.append((motion.q.detach(), torch.autograd.grad(looked_at(motion).sum(), x)[0]))
    for a, b in zip(*result, strict=True):
        assert_close(a, b, rtol=1e-9, atol=1e-12)


@pytest.mark.thorough
def test_a_lane_that_is_not_finite_fails_alone_and_is_named(native: None) -> None:
    gains = tensor(0.1, 2.0).requires_grad_()
    motion = mbd.simulate(arm(Steep()), 0.02, steps=8, designs={"controller.gain": gains}, backend="native")
    assert motion.status[0] == "ok"
    assert "module Steep of the controller 'controller' is not finite near t = 0.0" in motion.status[1]
    motion.q[0].square().sum().backward()
    assert float(gains.grad[0].abs()) > 0.0
    assert float(gains.grad[1]) == 0.0


class Late(nn.Module):
    """Wrong from a time on."""

    def __init__(self, wrong: Any):
        super().__init__()
        self.wrong, self.weight = wrong, nn.Parameter(tensor(1.0)[0])

    def forward(self, x: Tensor) -> Tensor:
        u = self.weight * x[:, :1].expand(-1, 2)
        return self.wrong(u) if float(x[0, -1].detach()) > 0.01 else u


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda u: u[:, :1], r"Late of the controller 'controller' gives torch.float64 \[1, 1\] at t = 0.0125 s"),
        (lambda u: u.detach(), "Late of the controller 'controller' gives a detached tensor at t = 0.0"),
        (lambda u: u @ u, "mat1 and mat2"),
    ],
    ids=["shape", "detached", "raises"],
)
def test_a_module_that_goes_wrong_later(native: None, wrong: Any, said: str) -> None:
    with pytest.raises((InputError, RuntimeError), match=said):
        mbd.simulate(arm(Late(wrong)), 0.02, steps=8, backend="native").q.sum().backward()


@pytest.mark.thorough
def test_a_law_that_goes_wrong_later(native: None) -> None:
    def law(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return -s if float(t) < 0.01 else -s[0]

    with pytest.raises(InputError, match=r"law .*law.* gives torch.float64 \[1, 1\] at t = 0.01"):
        mbd.simulate(sprung(law), 0.02, steps=8, backend="native", gradients="none")


@pytest.mark.thorough
def test_many_steps_in_one_segment_after_another(native: None) -> None:
    """Reverse mode makes the steps between two states that are kept again."""
    system, result = arm(), []
    for checkpoint in (1, 4):
        system.zero_grad()
        motion = mbd.simulate(system, 0.02, **OPTIONS, checkpoint=checkpoint, backend="native")
        motion.q[:, -1].square().sum().backward()
        result.append([p.grad.clone() for name, p in system.named_parameters() if name.startswith("controller")])
    for a, b in zip(*result, strict=True):
        assert_close(a, b, rtol=0, atol=1e-9 * float(a.abs().max()))
