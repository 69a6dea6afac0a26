"""A lock adds an equation for each freedom that its joint leaves."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from tests.mechanisms import box, turned
from tests.refused import refused
from torchmbd.multibody.joints.lock import Lock, freedoms

GROUND = mbd.Ground()
X, Y, Z, RX, RY, RZ = range(6)  # translations along the axes of frame a, rotations about them
JOINTS = {
    "revolute": (mbd.Revolute, {"axis": "y"}, [RY]),
    "spherical": (mbd.Spherical, {}, [RX, RY, RZ]),
    "universal": (mbd.Universal, {"axes": "zx"}, [RX, RZ]),
    "prismatic": (mbd.Prismatic, {"axis": "z"}, [Z]),
    "cylindrical": (mbd.Cylindrical, {"axis": "x"}, [X, RX]),
    "planar": (mbd.Planar, {}, [X, Y, RZ]),
}


@pytest.mark.parametrize("kind", JOINTS)
def test_freedoms_that_a_joint_leaves(kind):
    """Of a frame that is turned, on a body that is turned differently."""
    joint, given, expected = JOINTS[kind]
    axes, point = turned(0.3, -0.5, 0.8), (0.2, -0.1, 0.4)
    body = box("body", axes=turned(-0.9, 0.4, 0.1), position=point)
    assert freedoms(joint(GROUND.at(*point, axes=axes), body.at(), **given)) == expected


def test_a_link_leaves_all_but_one():
    body = box("body", position=(0.0, 0.6, 0.8))
    assert len(freedoms(mbd.DistanceJoint(GROUND.at(), body.at(), length=1.0))) == 5


def test_what_cannot_move_cannot_be_locked():
    joint = mbd.Fixed(GROUND.at(), box("body").at(), name="weld")
    with refused("weld"):
        Lock(joint, "lock")
