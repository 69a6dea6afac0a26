"""Points of bodies along a motion: rates against differences in time, first-order neighbors against simulated ones."""

from __future__ import annotations

import pytest
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import refused

pytestmark = pytest.mark.thorough

STEPS = 200


@pytest.fixture(scope="module")
def motion():
    return mbd.simulate(pendulum(), 0.02, steps=STEPS, gradients="forward", iterations=(6, 6), refresh=1).require_ok()


POINTS = {"origin": ("rod", None), "node": ("rod", 0), "rigid": ("arm", (0.1, -0.2, 0.05))}


@pytest.mark.parametrize("point", POINTS)
def test_rates_are_slopes_in_time(point, motion):
    name, where = POINTS[point]
    result = motion.body(name).at(where)
    h = 0.02 / STEPS
    for x, rate in ((result.position, result.velocity), (result.velocity, result.acceleration)):
        slope = (x[:, :-4] - 8 * x[:, 1:-3] + 8 * x[:, 3:-1] - x[:, 4:]) / (12 * h)
        assert_close(rate[:, 2:-2], slope, rtol=0, atol=2e-3 * float(rate.abs().max()))


def test_positions_are_those_of_the_deformed_mesh(motion):
    rod = motion.body("rod")
    for node in (0, 7, 11):
        assert_close(rod.at(node).position, rod.nodes[:, :, node], rtol=0, atol=1e-14)
        assert_close(rod.at(node).displacement, rod.displacements[:, :, node], rtol=0, atol=1e-16)


def test_an_attached_point_keeps_to_its_joint(motion):
    """The left end of the rod hangs on a point of the arm: same position, velocity and acceleration."""
    a, b = motion.body("rod").at("left"), motion.body("arm").at((0.2, 0.1, -0.05))
    assert_close(a.position, b.position, rtol=0, atol=1e-9)
    # Constraints are kept at the level of positions: their rates follow with the step size.
    assert_close(a.velocity, b.velocity, rtol=0, atol=1e-4 * float(b.velocity.abs().max()))


def test_points_that_do_not_exist(motion):
    with refused("point", "left"):
        motion.body("arm").at("left")
    with refused("node", "lefft", meant="left"):
        motion.body("rod").at("lefft")
    frame = motion.system.body("rod").at("left")
    assert_close(motion.body("rod").at(frame).position, motion.body("rod").at("left").position, rtol=0, atol=0)
    with refused("frame"):
        motion.body("arm").at(frame)
