"""The contract of joints and forces with the adjoint: its gradients are those of the tangents."""

from __future__ import annotations

import pytest
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.contracts import test_actions as actions
from tests.contracts import test_joints as joints
from tests.mechanisms import finished
from torchmbd.design.differentiate import differentiate

KINDS = {case.kind: case for case in joints.CASES}


def compared(system: mbd.System, duration: float) -> None:
    names = [name for name, _ in system.named_parameters()]
    options = {"steps": 3, "variables": names, "iterations": (5, 5)}
    expected, result = (
        differentiate(looked_at, finished(mbd.simulate(system, duration, gradients=way, **options))).gradient
        for way in ("forward", "reverse")
    )
    size = float(expected.abs().max())
    assert size > 0.0
    assert_close(result, expected, rtol=0, atol=1e-9 * size)


def looked_at(motion: mbd.Trajectory) -> Tensor:
    """A number of everything that was integrated, and of what follows from it."""
    parts = (motion.q, 0.1 * motion.v, 1e-3 * motion.a, 1e-3 * motion.lam)
    return sum((x * (1.0 + x)).flatten(1).sum(1) for x in parts)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("pair", ["rigid-flexible", "ground-rigid"])
def test_joints(kind, pair):
    """With a spring whose stiffness is a variable; of the second pair joints are condensed."""
    base = joints.joined(KINDS[kind], pair).system
    last = base.bodies[-1]
    end = last.at("right") if isinstance(last, mbd.FlexibleBody) else last.at(0.2, 0.1, 0.0)
    cord = mbd.SpringDamper(mbd.Ground().at(0.3, 1.1, 0.2), end, mbd.variable(40.0), mbd.variable(0.3), name="cord")
    compared(mbd.System(base.bodies, base.joints, [cord], gravity=(1.0, -9.0, 2.0)), 0.01)


@pytest.mark.thorough("rotationalstop", "rotationalspringdamper")
@pytest.mark.parametrize("name", actions.ELEMENTS)
def test_forces(name):
    base = actions.system_of(name)
    apart = mbd.Force(base.bodies[0].at(), (30.0, 20.0, -10.0))  # an element without stress has no gradient
    compared(mbd.System(base.bodies, forces=[*base.forces, apart], gravity=(1.0, -9.0, 2.0)), 1e-3)
