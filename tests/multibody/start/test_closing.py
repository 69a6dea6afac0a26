"""What the start moves to close joints: a warning beyond rounding, lists in describe and check, silence where nothing moves."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchmbd as mbd
from tests.multibody.start.test_initial import four_bar
from tests.refused import warned

GROUND = mbd.Ground()


def crane(kind: type = mbd.Spherical, gap: float = 0.0, size: float = 1.0, law: float = 0.0) -> mbd.System:
    """An arm, whose far end is `gap` from the tool that it holds, all `size` times as large."""
    small = (1e-3, 1e-3, 1e-3)
    arm = mbd.RigidBody("arm", 1.0, (0.1, 0.1, 0.1), position=(0.5 * size, 0.0, 0.0))
    tool = mbd.RigidBody("tool", 1e-3, small, position=(size, gap * size, 0.0))
    joints = [
        mbd.Revolute(GROUND.at(), arm.at(-0.5 * size, 0, 0), axis="z", name="hinge"),
        mbd.Drive(GROUND.at(), arm.at(-0.5 * size, 0, 0), axis="z", angle=lambda t: law + t, name="motor"),
        kind(arm.at(0.5 * size, 0, 0), tool.at(), name="grip"),
    ]
    return mbd.System([arm, tool], joints, gravity=(0.0, 0.0, -9.81))


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("kind", [mbd.Fixed, mbd.Spherical, mbd.Universal])
def test_a_body_far_from_its_joint_is_named(kind, size):
    """By the distance that it was put away, whatever the unit of length and the kind of the joint."""
    with warned(f"'grip' by {0.2 * size:.3g} m", f"'tool' by {0.2 * size:.3g} m"):
        motion = mbd.simulate(crane(kind, 0.2, size), 0.01, steps=2)
    assert motion.body("tool").r[0, 0].tolist() == pytest.approx([size, 0.0, 0.0], abs=1e-9 * size)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "run",
    [lambda s: mbd.equilibrium(s), lambda s: mbd.simulate(s, 0.01, steps=2, method="dopri5"), lambda s: s.describe()],
)
def test_every_start_tells(run):
    with warned("'grip' by 0.2 m"):
        run(crane(gap=0.2))


def test_a_start_of_the_caller_tells():
    with warned("'grip' by 0.3 m"):
        mbd.simulate(crane(), 0.01, steps=2, start={"tool.position": torch.tensor([1.0, 0.0, 0.3]).double()})


@pytest.mark.thorough
def test_a_drive_that_does_not_start_at_zero_tells():
    with warned("'motor' by 0.2 rad", "'arm' by ", " 0.2 rad"):
        mbd.simulate(crane(law=0.2), 0.01, steps=2)


@pytest.mark.thorough
@pytest.mark.parametrize("gap", [0.0, 1e-12, 5e-4])
def test_rounding_of_positions_is_no_mistake(gap):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        mbd.simulate(crane(gap=gap), 0.01, steps=2)
        result = crane(gap=gap).describe()
    assert [x.name for x in result.closing.bodies] == (["tool"] if gap > 1e-9 else [])


def test_describe_lists_all():
    with warned("open"):
        result = crane(gap=0.2).describe()
    (joint,), (body,) = result.closing.joints, result.closing.bodies
    assert (joint.name, body.name) == ("grip", "tool")
    assert (joint.distance, body.distance) == pytest.approx((0.2, 0.2), rel=1e-6)
    assert "open        'grip' by 0.2 m where the bodies were put" in str(result)
    assert "moved       'tool' by 0.2 m to close the joints" in str(result)


def test_other_designs_may_move_bodies_in_silence():
    """A longer arm pushes its tool: what the design is for."""
    arm = mbd.RigidBody("arm", 1.0, (0.1, 0.1, 0.1))
    tool = mbd.RigidBody("tool", 1.0, (1e-3, 1e-3, 1e-3), position=(1.0, 0.0, 0.0))
    grip = mbd.Fixed(arm.at(mbd.variable(1.0), 0.0, 0.0), tool.at(), name="grip")
    system = mbd.System([arm, tool], [mbd.Revolute(GROUND.at(), arm.at(), axis="z"), grip])
    (name,) = dict(system.named_parameters())
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        designs = {name: torch.full_like(dict(system.named_parameters())[name].detach(), 1.3)}
        motion = mbd.simulate(system, 0.01, steps=2, designs=designs)
    assert float(motion.body("tool").r[0, 0, 0].detach()) == pytest.approx(1.3)


@pytest.mark.thorough
def test_over_constraint_is_told_where_loads_are_asked_for():
    motion = mbd.simulate(four_bar(), 0.01, steps=2)
    assert "over-constraint  rows that follow from others" in repr(motion)
    with warned("joint 'revolute_ground_left'", "loads"):
        motion.reaction("revolute_ground_left")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        mbd.simulate(crane(), 0.01, steps=2).reaction("grip")


@pytest.mark.thorough
def test_a_joint_that_bends_a_body_is_closed_by_the_equilibrium():
    aluminium = mbd.Ply.isotropic(E=70e9, nu=0.33, density=2700.0)
    tube = mbd.sections.tube(0.02, aluminium, [0.0], 1e-3, cells=(6, 1))
    boom = mbd.FlexibleBody.beam("boom", mbd.BeamLine.straight(1.0, elements=2), tube, modes=4, reference="start")
    hook = mbd.PointOnPlane(GROUND.at(1.0, 0.0, -0.005), boom.at("end"), normal="z", name="hook")
    system = mbd.System([boom], [mbd.Fixed(GROUND.at(), boom.at("start"), name="root"), hook])
    with pytest.warns(UserWarning, match="'hook' by 0.005 m; they are closed in the static equilibrium of the start"):
        motion = mbd.simulate(system, 0.01, steps=2, start="equilibrium", gradients="none").require_ok()
    assert float(motion.body("boom").r[0, 0].norm()) < 1e-9
    description = system.describe()
    assert [way.name for way in description.closing.joints] == ["hook"]
    assert not description.closing.bodies
    assert (description.closes, description.frequencies) == (False, ())
    assert "not closed  no rigid displacement closes these joints" in str(description)


def test_rounding_of_points_at_one_place_is_not_listed():
    bracket = mbd.RigidBody("bracket", 1.0, (0.1, 0.1, 0.1), position=(1.7e-18, 0.0, 1e-17))
    description = mbd.System([bracket], [mbd.Fixed(GROUND.at(), bracket.at())]).describe()
    assert (description.closing.joints, description.closing.bodies, description.closing.far) == ((), (), False)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
@pytest.mark.parametrize("gap", [0.5, 4.0, 10.0, 60.0])
def test_a_coupling_tells_its_gap_as_an_angle_and_its_wheels_tell_full_turns(gap, unit):
    """Whatever the unit of the factors; the rotations of the wheels are those that its joints count."""
    wheels = [mbd.RigidBody(name, 1.0, (0.01, 0.01, 0.02)) for name in ("small", "large")]
    small, large = [mbd.Revolute(GROUND.at(), wheel.at(), axis="z") for wheel in wheels]
    gear = mbd.JointCoupling([small.angle, large.angle], [unit, -2.0 * unit], offset=2.0 * unit * gap, name="gear")
    with warned(f"'gear' by {gap:.3g} rad", f"'small' by {0.4 * gap:.3g} rad", f"'large' by {0.8 * gap:.3g} rad"):
        mbd.System(wheels, [small, large, gear]).describe()
