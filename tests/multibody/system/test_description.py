"""What a system says of itself: rows, rank, redundant rows by name, freedoms, mass, frequencies; bodies that are left out."""

from __future__ import annotations

import math

import pytest

import torchmbd as mbd
from tests.mechanisms import box, plate
from tests.multibody.start.test_initial import four_bar
from tests.refused import ANY, refused
from torchmbd.examples.slider_crank import build


def test_a_four_bar_of_hinges():
    result = four_bar().describe()
    assert (result.rows, result.rank, result.freedoms, result.mobility) == (20, 17, 1, 1)
    assert len(result.redundant) == 3
    assert len(set(result.redundant)) == 3
    assert result.mass == 3.0
    assert result.separate == ()
    text = str(result)
    assert "rows        20, rank 17" in text
    assert "revolute_ground_left   Revolute  5     ground.at(0, 0, 0) - left.at(0, 0, 0)" in text


@pytest.mark.thorough
def test_the_slider_crank_of_the_paper():
    result = build(1, [30.0], cells=(6, 2), modes=2).describe()
    assert (result.rows, result.rank, result.redundant, result.freedoms, result.mobility) == (18, 18, (), 2, 0)
    assert [(entry.name, entry.kind, entry.numbers["modes"]) for entry in result.bodies] == [
        ("crank", "rigid", 0),
        ("rod", "flexible", 2),
        ("slider", "rigid", 0),
    ]
    assert len(result.frequencies) == 2
    assert 0.0 < result.frequencies[0] < result.frequencies[1]


def test_frequencies_of_a_pendulum():
    arm = mbd.RigidBody("arm", 2.0, (0.2, 0.1, 0.3), center=(0.0, -0.5, 0.0))
    system = mbd.System([arm], [mbd.Revolute(mbd.Ground().at(), arm.at())], gravity=(0.0, -9.81, 0.0))
    expected = math.sqrt(2.0 * 9.81 * 0.5 / (0.3 + 2.0 * 0.25)) / (2.0 * math.pi)
    assert system.describe().frequencies == pytest.approx((expected,), rel=1e-12)


def test_groups_that_fly_are_named():
    a, b, c = box("a"), box("b"), box("c")
    system = mbd.System([a, b, c], [mbd.Revolute(a.at(), b.at())], free=["c"])
    result = system.describe()
    assert result.separate == (("a", "b"), ("c",))
    assert result.freedoms == 13
    assert "a, b: no joint to the ground" in str(result)


def test_a_free_body_has_no_joints_to_print():
    result = mbd.System([box("a")]).describe()
    assert (result.rows, result.rank, result.freedoms) == (0, 0, 6)
    assert "no joint" in str(result)


def test_a_body_left_unconnected_is_named():
    a, b, c = box("a"), box("b"), box("c")
    joints = [mbd.Revolute(mbd.Ground().at(), a.at())]
    with refused("bodies"):
        mbd.System([a, b, c], joints)
    with refused("free"):
        mbd.System([a, b, c], joints, free=["b", "c", "d"])


def test_a_drive_on_a_motion_that_joints_hold_is_named():
    a = box("a")
    ground = mbd.Ground()
    held = mbd.System([a], [mbd.Fixed(ground.at(), a.at()), mbd.Drive(ground, a, speed=1.0, name="motor")])
    for run in (held.describe, lambda: mbd.simulate(held, 0.1, steps=5)):
        with refused("motor: angle"):
            run()


def test_two_drives_of_one_motion_are_named():
    a, ground = box("a"), mbd.Ground()
    joints = [mbd.Revolute(ground.at(), a.at()), *(mbd.Drive(ground, a, speed=s, name=f"motor_{s}") for s in (1, 2))]
    with refused("motor_1: angle", ANY, "'motor_2: angle'"):
        mbd.System([a], joints).describe()


@pytest.mark.parametrize("ask", [lambda system: system.describe(), lambda system: mbd.equilibrium(system).vibrations])
def test_freedoms_without_inertia_are_named(ask):
    """A rod without inertia about its axis, which a ball joint leaves free, has no vibrations."""
    rod = mbd.RigidBody("rod", 1.0, (0.0, 0.1, 0.1), position=(0.5, 0, 0))
    system = mbd.System([rod], [mbd.Spherical(mbd.Ground().at(), rod.at(-0.5, 0, 0))], gravity=(9.81, 0, 0))
    with refused("system", ANY, "without inertia", kind=mbd.DesignFailure):
        ask(system)


def test_frames_are_shown_by_the_names_of_their_nodes():
    """An edge by its name, of an interface too; nodes without a name by few numbers."""
    body = plate("leaf", cells=(8, 8))
    edge = list(body.mesh.node_sets["left_edge"])
    assert repr(body.at("left_edge")) == repr(body.at(edge[::-1])) == "leaf.at('left_edge')"
    assert repr(body.at(body.mesh.node("center"))) == "leaf.at('center')"
    uneven = body.at("left_edge", weights=[1.0 + k for k in range(len(edge))])
    assert repr(uneven) == f"leaf.at(9 nodes, {min(edge)} to {max(edge)})"
    assert repr(body.at(edge[:2])) == f"leaf.at(nodes {edge[:2]})"


def test_a_joint_that_is_listed_twice_is_refused():
    body = box("a")
    joint, spring = mbd.Revolute(mbd.Ground().at(), body.at()), mbd.Force(body.at(), (1.0, 0.0, 0.0))
    with refused("joints.revolute_ground_a"):
        mbd.System([body], [joint, joint])
    with refused("forces.force_a"):
        mbd.System([body], [joint], [spring, spring])


def test_joints_with_the_same_equations_are_told():
    """Each with its own number of rows, under one name or two; hinges at other places are not repeated."""
    ground, body = mbd.Ground(), box("a")
    hinges = [mbd.Revolute(ground.at(), body.at()) for _ in range(2)]
    far = mbd.Spherical(ground.at(0.5, 0.0, 0.0), body.at(0.5, 0.0, 0.0), name=hinges[0].name)
    result = mbd.System([body], [*hinges, far]).describe()
    assert [entry.numbers["rows"] for entry in result.joints] == [5, 5, 3]
    assert result.repeated == ("revolute_ground_a",)
    assert "repeated    revolute_ground_a: an earlier joint has these equations" in str(result)


@pytest.mark.parametrize("name", ["a", "arm"])
def test_a_joint_on_a_body_that_is_not_in_the_system_is_named(name):
    body, other = box("a"), box(name)
    with refused("bodies", ANY, f"hold bodies that are not in this list: {name!r}"):
        mbd.System([body], [mbd.Revolute(mbd.Ground().at(), other.at())])


def test_a_body_that_falls_freely_has_no_frequencies_of_gravity():
    inertia = (0.1, 0.2, 0.3)
    free = mbd.RigidBody("free", 1.0, inertia, (0.3, 0.0, 0.1))
    bob = mbd.RigidBody("bob", 1.0, inertia, (0.0, -1.0, 0.0))
    hinge = mbd.Revolute(mbd.Ground().at(), bob.at(), axis="z")
    description = mbd.System([free, bob], [hinge], gravity=(0.0, -9.81, 0.0), free=["free"]).describe()
    swing = (9.81 / 1.3) ** 0.5 / (2.0 * math.pi)
    assert description.frequencies == pytest.approx([0.0] * 6 + [swing], abs=1e-6)
