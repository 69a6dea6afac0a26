"""Public robots against the recursion of Newton and Euler. Needs FLEXIBLE_ARM_MODELS, EXAMPLE_ROBOT_DATA."""

from __future__ import annotations

import pytest

from experiments.peers import robots
from tests.public_files import public_file

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # limits about a turn apart, inertia that no mass has


@pytest.mark.parametrize("name", robots.ARM_FILES, ids=lambda path: path.stem)
def test_the_arm_of_three_joints_follows_the_recursion(name):
    """Rigid, and as its authors cut it into segments."""
    own = robots.compared(public_file(robots.ARM, name))
    assert max(own.turning, own.moving) < 1e-10


@pytest.mark.parametrize(
    ("name", "coordinates", "stops"),
    [
        ("ur_description/urdf/ur5_robot.urdf", 6, 0),
        ("panda_description/urdf/panda.urdf", 8, 8),
        ("anymal_b_simple_description/robots/anymal.urdf", 12, 0),
        ("talos_data/robots/talos_reduced.urdf", 32, 32),
    ],
)
def test_robots_follow_the_recursion(name, coordinates, stops):
    own = robots.compared(public_file(robots.ALL, name))
    assert (own.coordinates, own.stops) == (coordinates, stops)
    assert max(own.turning, own.moving) < 1e-10
