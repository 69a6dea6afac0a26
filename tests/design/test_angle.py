"""Angle of a body: of a hinge, of bodies turned at will, its range, what it refuses."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, tensor, turned
from torchmbd.design import Angle
from torchmbd.design.response_spec import measure_of


def swing(rate: float, axes: torch.Tensor) -> mbd.Trajectory:
    """A body in a hinge about its y axis that turns at a steady rate, on a frame turned at will."""
    ground = mbd.Ground()
    door = box("door", axes=axes, center=(0.0, 0.0, 0.0))
    joints = [
        mbd.Revolute(ground.at(0, 0, 0, axes=axes), door.at(0, 0, 0), axis="y"),
        mbd.Drive(ground.at(0, 0, 0, axes=axes), door, axis="y", speed=rate),
    ]
    return mbd.simulate(mbd.System([door], joints), 1.0, steps=50).require_ok()


def test_angle_of_a_hinge_grows_with_time():
    """Three quarters of a turn: a range around its middle has no jump, one around zero has one of a turn."""
    rate, axes = 1.5 * math.pi, turned(0.4, -0.7, 0.3)
    motion = swing(rate, axes)
    expected = rate * motion.t
    normal = tuple(axes[:, 1].tolist())
    found = Angle("door", normal, center=0.75 * math.pi).values(motion)[0]
    assert_close(found - found[0], expected, rtol=0, atol=1e-6)
    around_zero = Angle("door", normal).values(motion)[0]
    assert float(around_zero.max()) <= math.pi
    turns = (found - around_zero) / (2.0 * math.pi)
    assert_close(turns, turns.round(), rtol=0, atol=1e-9)


def test_angle_between_two_bodies_is_that_of_their_rotation():
    """Bodies at rest, turned from one another by 0.3 rad about y, in a general position; the sign changes with the observer."""
    first = turned(0.9, 0.2, -1.1)
    a, b = box("a", axes=first), box("b", axes=first @ turned(0.0, 0.3, 0.0))
    motion = mbd.simulate(mbd.System([a, b], []), 0.1, steps=2)
    assert_close(Angle("b", "y", seen_from="a").values(motion)[0, 0], tensor(0.3)[0], rtol=0, atol=1e-9)
    assert_close(Angle("a", "y", seen_from="b").values(motion)[0, 0], tensor(-0.3)[0], rtol=0, atol=1e-9)


def test_a_file_may_ask_for_it():
    measure = measure_of({"final": {"angle": {"body": "b", "axis": "y", "seen_from": "a"}}})
    assert measure.history == Angle("b", "y", seen_from="a")


def test_errors_name_the_argument():
    system = mbd.System([box("a")], [])
    for given, said in (
        ({"axis": "w"}, "axis is 'w'"),
        ({"axis": "x", "seen_from": "c"}, "'c'"),
        ({"axis": "x", "seen_from": "a"}, "seen from itself"),
        ({"axis": "x", "center": math.nan}, "center of an angle is nan"),
        ({"axis": "x", "center": "half"}, "center of an angle is 'half'"),
    ):
        with pytest.raises(mbd.InputError, match=said):
            Angle("a", **given).check(system)
