"""Numbers of a motion pushed forward: the same as those pulled back, of histories and of the design itself."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.design.differentiate import differentiate, push_forward
from torchmbd.examples import two_link_arm

RESPONSES = {
    "point of a flexible body": mbd.Position("arm", "y", node="right"),
    "rate": mbd.Velocity("tool", "y"),
    "force of a joint": mbd.Reaction("hinge", "x"),
    "energy": mbd.StrainEnergy("arm"),
}


@pytest.fixture(scope="module")
def motion():
    designs = {"arm.laminate.angles": mbd.deg([[45.0, -45.0], [10.0, 30.0]])}
    return mbd.simulate(mbd.examples.arm(), 0.05, steps=20, gradients="forward", designs=designs)


@pytest.mark.thorough
@pytest.mark.parametrize("name", RESPONSES)
def test_gradients_are_those_of_reverse_mode(motion, name):
    by_rows, pushed = (way(RESPONSES[name].values, motion) for way in (differentiate, push_forward))
    assert pushed.gradient.shape == (2, 21, 2)
    assert_close(pushed.value, by_rows.value)
    assert_close(pushed.gradient, by_rows.gradient, rtol=1e-9, atol=1e-9 * float(by_rows.gradient.abs().max()))


@pytest.mark.thorough
def test_numbers_of_the_design_itself_are_pushed_too(motion):
    by_rows, pushed = (way(mbd.Frequency("arm").value, motion) for way in (differentiate, push_forward))
    assert_close(pushed.gradient, by_rows.gradient, rtol=1e-8, atol=1e-8)


@pytest.mark.thorough
def test_a_motion_of_phases():
    """Values after the switch carry its moving time."""
    system = two_link_arm.build(cells=(2, 2), modes=1)
    motion = mbd.simulate(system, 0.8, steps=80, phases=two_link_arm.phases(), gradients="forward")

    def rows(motion):
        return mbd.AtTime(mbd.Angle("fore", "z"), 0.75).value(motion)[:, None]

    by_rows, pushed = (way(rows, motion) for way in (differentiate, push_forward))
    assert_close(pushed.gradient, by_rows.gradient, rtol=1e-8, atol=1e-10)


def test_a_motion_without_tangents_is_refused():
    motion = mbd.simulate(mbd.examples.pendulum(), 0.1, steps=4, gradients="none")
    with refused("motion"):
        push_forward(lambda m: torch.zeros(1), motion)
