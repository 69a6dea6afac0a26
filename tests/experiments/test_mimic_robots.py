"""Public robots with mimic joints against MuJoCo's hard limit. Needs `mujoco`, ROBOTIQ_85, EXAMPLE_ROBOT_DATA."""

from __future__ import annotations

import pytest

from experiments.peers import mimic_robots
from tests.public_files import public_file

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # what is left out


@pytest.mark.parametrize(
    ("variable", "name", "joints", "mimics"),
    [
        ("ROBOTIQ_85", "robots/robotiq_arg85_description.URDF", 6, 5),
        ("EXAMPLE_ROBOT_DATA", "panda_description/urdf/panda.urdf", 9, 1),
    ],
)
def test_joints_that_mimic_others_move_as_in_the_hard_limit_of_mujoco(variable, name, joints, mimics):
    pytest.importorskip("mujoco")
    result = mimic_robots.compared(public_file(variable, name))
    assert (result.joints, result.mimics) == (joints, mimics)
    assert max(result.turning, result.moving) < 1e-10
    assert result.places < 1e-8
