"""Angle of a body: of a hinge, of bodies turned at will, its range, what it refuses."""

from __future__ import annotations

import math
from itertools import permutations, product

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, tensor, turned
from tests.refused import refused
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


@pytest.mark.thorough
def test_angle_of_a_hinge_grows_with_time():
    """Three quarters of a turn; another center changes it by whole turns."""
    rate, axes = 1.5 * math.pi, turned(0.4, -0.7, 0.3)
    motion = swing(rate, axes)
    expected = rate * motion.t
    normal = tuple(axes[:, 1].tolist())
    result = Angle("door", normal).values(motion)[0]
    assert_close(result - result[0], expected, rtol=0, atol=1e-6)
    further = Angle("door", normal, center=7.0 * math.pi).values(motion)[0]
    assert abs(float(further[0]) - 7.0 * math.pi) <= math.pi
    turns = (further - result) / (2.0 * math.pi)
    assert_close(turns, turns[0].round().expand_as(turns), rtol=0, atol=1e-9)
    wrapped = Angle("door", normal, wrapped=True).values(motion)[0]
    assert float(wrapped.max()) <= math.pi
    turns = (result - wrapped) / (2.0 * math.pi)
    assert_close(turns, turns.round(), rtol=0, atol=1e-9)


def cube_rotations() -> list[torch.Tensor]:
    """The 24 rotations that map the axes onto axes."""
    identity = torch.eye(3, dtype=torch.float64)
    signed = [
        identity[list(p)] * tensor(s)[0][:, None]
        for p in permutations(range(3))
        for s in product((1.0, -1.0), repeat=3)
    ]
    return [x for x in signed if torch.linalg.det(x) > 0.0]


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_angle_grows_with_time_however_the_axes_of_the_body_are_put(axis):
    """The body axis of the default lies along the hinge in eight of the 24: they give the angle of another axis."""
    rate, ground, rotations = 1.5, mbd.Ground(), cube_rotations()
    assert len(rotations) == 24
    doors = [box(f"door_{k}", axes=axes) for k, axes in enumerate(rotations)]
    joints: list = []
    for door in doors:
        joints += [mbd.Revolute(ground.at(), door.at(), axis=axis), mbd.Drive(ground, door, axis=axis, speed=rate)]
    post = box("post", axes=turned(0.4, -0.7, 0.3))
    system = mbd.System([post, *doors], [mbd.Fixed(ground.at(), post.at()), *joints])
    motion = mbd.simulate(system, 0.2, steps=4, backend="eager", diagnose=False).require_ok()
    e = torch.eye(3, dtype=torch.float64)["xyz".index(axis)]
    for door in doors:
        for observer, direction in (("ground", e), ("post", post.axes.T @ e)):
            angle = Angle(door.name, tuple(direction.tolist()), seen_from=observer)(motion)[0]
            assert_close(angle - angle[0], rate * motion.t, rtol=0, atol=1e-9)


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
    for given, path in (
        ({"axis": "w"}, "axis"),
        ({"axis": "x", "seen_from": "c"}, "body"),
        ({"axis": "x", "seen_from": "a"}, "seen_from"),
        ({"axis": "x", "center": math.nan}, "center"),
        ({"axis": "x", "wrapped": "yes"}, "wrapped"),
        ({"axis": "x", "center": "half"}, "center"),
    ):
        with refused(path):
            Angle("a", **given).check(system)


def spinning(speed: float = 6.0) -> mbd.System:
    crank = mbd.RigidBody("crank", 1.0, (0.01,) * 3, angular_velocity=(0.0, 0.0, speed))
    return mbd.System([crank], [mbd.Revolute(mbd.Ground().at(), crank.at(), axis="z", name="hinge")])


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [10, 400])
def test_an_angle_is_continuous_along_a_motion(steps):
    """Nearly two turns: the largest was half a turn and more, from a spline through the jump."""
    motion, angle = mbd.simulate(spinning(), 2.0, steps=steps, gradients="none"), Angle("crank", "z")
    assert_close(angle(motion)[0], 6.0 * motion.t, rtol=0, atol=1e-9)
    assert float(mbd.Max(angle)(motion)) == pytest.approx(12.0, abs=1e-9)
    assert float(mbd.Min(angle)(motion)) == pytest.approx(0.0, abs=1e-9)
    assert float(mbd.AtTime(angle, math.pi / 6.0)(motion)) == pytest.approx(math.pi, abs=1e-9)
    wrapped = Angle("crank", "z", wrapped=True)
    assert float(wrapped(motion).abs().max()) <= math.pi
    with refused("history.wrapped", True):
        mbd.Max(wrapped + 1.0)


def test_turns_of_a_body_seen_from_one_that_turns_and_tilts():
    """Counted from rates, in a general position; the difference of both angles on one axis."""
    axes = turned(0.4, -0.7, 0.3)
    round_one = {"axes": axes, "center": (0.0, 0.0, 0.0), "inertia": (0.1, 0.1, 0.1)}
    bodies = [box(name, angular_velocity=(0.0, rate, 0.0), **round_one) for name, rate in (("a", 3.0), ("b", -4.0))]
    motion = mbd.simulate(mbd.System(bodies, [], free=["a", "b"]), 2.0, steps=20, gradients="none")
    result = Angle("b", "y", seen_from="a")(motion)[0]
    assert_close(result, -7.0 * motion.t, rtol=0, atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("first", [[], [mbd.Phase(lasting=0.9)]], ids=["at the start", "later"])
def test_an_event_sees_the_continuous_angle(first):
    """A crank that turns forward never falls to -0.5 rad, and passes 7 rad in its second turn."""

    def time(function: mbd.History, direction: str) -> mbd.Trajectory:
        phases = [*first, mbd.Phase(until=mbd.Event(function, direction)), mbd.Phase(lock=["hinge"])]
        return mbd.simulate(spinning(), 2.0, steps=200, phases=phases, gradients="none")

    angle = Angle("crank", "z")
    never = time(angle + 0.5, "falling")
    assert "its event does not occur" in never.status[0]
    for function, at in ((angle - 7.0, 7.0), (angle**2 - 100.0, 10.0)):
        result = time(function, "rising").require_ok()
        assert float(result.switches[-1].t) == pytest.approx(at / 6.0, abs=1e-9)
        assert float(mbd.Max(angle)(result)) == pytest.approx(at, abs=1e-8)


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_the_time_of_an_event_after_turns_has_its_gradient(mode):
    """theta^2 = 100 at t = 10 / w: the derivative by the speed w needs the turns of theta."""
    speed = torch.nn.Parameter(tensor(0.0, 0.0, 6.0))
    crank = mbd.RigidBody("crank", 1.0, (0.01,) * 3, angular_velocity=speed)
    system = mbd.System([crank], [mbd.Revolute(mbd.Ground().at(), crank.at(), axis="z", name="hinge")])
    phases = [mbd.Phase(until=mbd.Event(Angle("crank", "z") ** 2 - 100.0, "rising")), mbd.Phase(lock=["hinge"])]
    motion = mbd.simulate(system, 2.0, steps=200, phases=phases, gradients=mode).require_ok()
    [slope] = torch.autograd.grad(motion.switches[0].t.sum(), list(motion.variables.values()))
    assert float(slope.flatten()[2]) == pytest.approx(-10.0 / 36.0, rel=1e-6)
