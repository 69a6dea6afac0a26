"""Public mechanisms against MuJoCo. Needs the package `mujoco`, MUJOCO_MODELS, DM_CONTROL_SUITE, UNITREE_ROBOTS."""

from __future__ import annotations

import pytest

from experiments.peers import mujoco_models
from tests.public_files import public_file

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # what is left out


@pytest.mark.parametrize(
    ("variable", "name", "coordinates", "limits"),
    [
        ("MUJOCO_MODELS", "humanoid/humanoid.xml", 21, 21),
        ("DM_CONTROL_SUITE", "cheetah.xml", 9, 6),
        ("DM_CONTROL_SUITE", "humanoid_CMU.xml", 56, 56),
        ("UNITREE_ROBOTS", "h1/h1.xml", 20, 19),
    ],
)
def test_bodies_accelerate_as_in_mujoco(variable, name, coordinates, limits):
    pytest.importorskip("mujoco")
    result = mujoco_models.compared(public_file(variable, name))
    assert (result.coordinates, result.stops) == (coordinates, limits)
    assert max(result.turning, result.moving) < 1e-10
