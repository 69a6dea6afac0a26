"""Histories against mechanics: rates seen by a moving observer, reactions against Newton's law, what they refuse."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, box, pendulum, tensor, turned
from tests.refused import warned
from torchmbd.design import (
    Acceleration,
    Displacement,
    Position,
    Reaction,
    RelativeDisplacement,
    StrainEnergy,
    Velocity,
)

pytestmark = pytest.mark.usefixtures("compiled")

STEPS, DURATION = 200, 0.02
HINGE, JOINT = "revolute_ground_arm", "universal_arm_rod"


@pytest.fixture(scope="module")
def motion() -> mbd.Trajectory:
    return mbd.simulate(pendulum(), DURATION, steps=STEPS, iterations=(6, 6), refresh=1).require_ok()


@pytest.mark.thorough
@pytest.mark.parametrize("observer", ["ground", "arm", "rod"])
def test_rates_are_slopes_of_what_the_observer_sees(observer, motion):
    def seen(kind):
        parts = [kind("rod", axis, node=0, seen_from=observer).values(motion) for axis in "xyz"]
        return torch.stack(parts, -1)

    h = DURATION / STEPS
    # What a moving observer sees is the difference of larger numbers, whose error in time it inherits.
    point = motion.body("rod").at(0)
    sizes = point.velocity, point.acceleration
    for x, rate, size in zip(
        (seen(Position), seen(Velocity)), (seen(Velocity), seen(Acceleration)), sizes, strict=True
    ):
        slope = (x[:, :-4] - 8 * x[:, 1:-3] + 8 * x[:, 3:-1] - x[:, 4:]) / (12 * h)
        assert_close(rate[:, 2:-2], slope, rtol=0, atol=2e-3 * float(size.abs().max()))


@pytest.fixture(scope="module")
def precise() -> mbd.Trajectory:
    return mbd.simulate(pendulum(), 0.004, steps=80, method="dopri8", rtol=1e-11, atol=1e-13).require_ok()


@pytest.mark.thorough
@pytest.mark.parametrize(
    "history",
    [
        StrainEnergy("rod"),
        Position("rod", "x", node="right"),
        Position("rod", (1.0, 2.0, -2.0), node=0, seen_from="arm"),
        Displacement("rod", "z", node="right"),
        Displacement("arm", "x", point=(0.2, 0.1, -0.05)),
        RelativeDisplacement("rod", 0, "right", "z"),
        1e3 * Displacement("rod", "z", node="right") ** 2 - 0.5 * StrainEnergy("rod"),
    ],
    ids=lambda history: type(history).__name__,
)
def test_known_rates_are_slopes_of_the_history(history, precise):
    """Against differences of fourth order of a motion at close tolerances."""
    y, h = history.values(precise), 0.004 / 80
    for order, rate in enumerate(history.rates(precise), start=1):
        y = (y[:, :-4] - 8 * y[:, 1:-3] + 8 * y[:, 3:-1] - y[:, 4:]) / (12 * h)
        cut = slice(2 * order, -2 * order)
        assert_close(rate[:, cut], y, rtol=0, atol=1e-4 * float(rate.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "history",
    [
        Velocity("rod", "x", node="right"),
        Displacement("rod", "z", node="right", axes="ground"),
        RelativeDisplacement("rod", 0, "right", "z", axes="ground"),
        StrainEnergy("rod") - Reaction(JOINT, "x"),
    ],
    ids=lambda history: type(history).__name__,
)
def test_rates_that_are_not_known_are_not_claimed(history, motion):
    assert history.rates(motion) is None


@pytest.mark.thorough
def test_axes_turn_a_vector_and_keep_its_length(motion):
    def length(**given):
        return sum(Velocity("rod", axis, node="right", **given).values(motion) ** 2 for axis in "xyz")

    assert_close(length(axes="arm"), length(), rtol=1e-12, atol=0)
    assert_close(length(seen_from="arm", axes="rod"), length(seen_from="arm"), rtol=1e-12, atol=0)
    along = Velocity("rod", (3.0, 0.0, 4.0), node="right").values(motion)
    x, z = (Velocity("rod", axis, node="right").values(motion) for axis in "xz")
    assert_close(along, 0.6 * x + 0.8 * z)


@pytest.mark.thorough
def test_displacements(motion):
    """Seen from the body itself: elastic. Seen from elsewhere: what changed since the start."""
    rod = motion.body("rod")
    assert_close(Displacement("rod", "z", node=0).values(motion), rod.displacements[:, :, 0, 2])
    seen = Displacement("rod", "x", node=0, seen_from="ground").values(motion)
    assert_close(seen, rod.nodes[:, :, 0, 0] - rod.nodes[:, :1, 0, 0], rtol=0, atol=1e-14)
    twist = RelativeDisplacement("rod", 0, "right", "z").values(motion)
    right = rod.mesh.node("right")
    assert_close(twist, rod.displacements[:, :, 0, 2] - rod.displacements[:, :, right, 2], rtol=0, atol=1e-18)
    hung = Position("rod", "y", node="left", seen_from="arm").values(motion)
    assert_close(hung, torch.full_like(hung, 0.1), rtol=0, atol=1e-9)


def force(motion, joint: str, **given) -> torch.Tensor:
    return torch.stack([Reaction(joint, axis, **given).values(motion) for axis in "xyz"], -1)


@pytest.mark.thorough
def test_a_reaction_is_what_moves_the_body(motion):
    """Newton: the joint carries the mass times acceleration of all nodes of the rod, less their weight."""
    rod, body = motion.body("rod"), motion.system.body("rod")
    laminate = body.laminate
    mass = body.matrices.lumped_mass(laminate.mass_per_area, laminate.rotary_inertia_per_area).detach()[0::6]
    rate = sum(m * (rod.at(k).acceleration - tensor(*GRAVITY)) for k, m in enumerate(mass))
    result = force(motion, JOINT)
    assert_close(result, rate, rtol=0, atol=1e-8 * float(result.abs().max()))
    assert float(result.abs().max()) > 0.1


@pytest.mark.thorough
def test_action_is_reaction_and_a_hinge_turns_freely(motion):
    assert_close(force(motion, JOINT, on="arm"), -force(motion, JOINT), rtol=0, atol=1e-12)
    torque = force(motion, HINGE, kind="torque")
    hinge = motion.system.joints[0].a.axis("x")
    size = float(torque.abs().max())
    assert size > 1e-2
    assert float((torque @ hinge).abs().max()) < 1e-9 * size
    assert float((torque @ motion.system.joints[0].a.axis("y")).abs().max()) > 1e-2 * size


@pytest.mark.parametrize(
    ("history", "words"),
    [
        (Velocity("rod", "w"), "axis = 'w': must be 'x', 'y', 'z', or a direction"),
        (Velocity("rod", "100"), "axis = '100': must be 'x', 'y', 'z', or a direction"),
        (Velocity("rod", (0.0, 0.0, 0.0)), "axis = (0.0, 0.0, 0.0)"),
        (Velocity("rod", "x", node="lefft"), "Try: 'left'"),
        (Velocity("arm", "x", node="left"), "body 'arm' is rigid"),
        (Velocity("rod", "x", point=(0, 0, 0)), "point is (0, 0, 0) on the flexible body 'rod': must be None"),
        (Velocity("rod", "x", seen_from="amr"), "Try: 'arm'"),
        (Velocity("rod", "x", axes="amr"), "Try: 'arm'"),
        (Displacement("rod", "x", seen_from="rod"), "is zero: must have a node, or seen_from"),
        (RelativeDisplacement("rod", 0, 999, "z"), "node = 999"),
        (Reaction("universal_arm", "x"), "Try: 'universal_arm_rod'"),
        (Reaction(JOINT, "x", kind="moment"), "kind = 'moment': must be one of force, torque"),
        (Reaction(JOINT, "x", on="ground"), "= 'ground': must be one of arm, rod"),
    ],
    ids=str,
)
def test_what_the_system_does_not_have(history, words):
    with pytest.raises(mbd.InputError) as error:
        history.check(pendulum())
    assert words in str(error.value)


def test_a_displacement_of_the_reference_node_seen_from_its_body_is_told():
    system = mbd.examples.arm()
    fixed, free = (mbd.Displacement("arm", "z", node=node) for node in ("center", "right"))
    with warned("'center'", "'arm'", "seen_from='ground'"):
        fixed.check(system)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free.check(system)
        mbd.Displacement("arm", "z", node="center", seen_from="ground").check(system)


@pytest.mark.parametrize(
    ("kind", "free"),
    [
        (mbd.Revolute, {("z", "torque")}),
        (mbd.Prismatic, {("z", "force")}),
        (mbd.Cylindrical, {("z", "force"), ("z", "torque")}),
        (mbd.Spherical, {("x", "torque"), ("y", "torque"), ("z", "torque")}),
    ],
)
def test_reactions_along_what_a_joint_leaves_free_are_told(kind, free):
    """Exactly those are told that are zero in a motion under a general load, in a frame that is turned."""
    body = box("block", position=(0.1, 0.2, 0.3))
    turn = turned(0.4, -0.7, 0.3)
    frames = mbd.Ground().at(axes=turn), body.at(-0.1, -0.2, -0.3)
    joint = kind(*frames, name="joint") if kind is mbd.Spherical else kind(*frames, axis="z", name="joint")
    loads = [mbd.Force(body.at(0.1, 0.0, 0.2), (30.0, 20.0, -50.0)), mbd.Torque(body.at(), (1.0, 2.0, 3.0))]
    system = mbd.System([body], [joint], loads)
    motion = mbd.simulate(system, 0.01, steps=20, backend="eager", gradients="none")
    for k, axis in enumerate("xyz"):
        for what in ("force", "torque"):
            history = mbd.Reaction("joint", turn[:, k].tolist(), what)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                history.check(system)
            assert any("'joint'" in str(x.message) for x in caught) == ((axis, what) in free)
            assert (float(history.values(motion)[0, 5:].abs().max()) < 1e-8) == ((axis, what) in free)
