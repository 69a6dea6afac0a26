"""Condensed systems against the same systems with nothing condensed: same motion, same reactions, fewer unknowns."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.examples.slider_crank import build
from torchmbd.integrate.prepared import initial
from torchmbd.multibody.equations import equations
from torchmbd.multibody.saddle.condensation import _Poses, condense
from torchmbd.multibody.system import Dynamics

pytestmark = pytest.mark.usefixtures("compiled")
GROUND = mbd.Ground()
NAME = "rod.laminate.angles"
TIGHT = {"iterations": (5, 2)}


def body(name: str, **options) -> mbd.RigidBody:
    return mbd.RigidBody(name, mass=2.0, inertia=(0.02, 0.03, 0.04), center=(0.1, 0.05, -0.02), **options)


def whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dynamics, "condensed", lambda self: self)


def left(system: mbd.System):
    result = system._initial.condensed
    assert result is not None
    return result


def driven(angle) -> mbd.System:
    """A tilted, driven arm that swings a pendulum: the drive names the moving body first, its law does not start at zero."""
    arm = body("arm", position=(0.3, 0.1, 0.0))
    bob = body("bob", position=(0.8, 0.1, 0.0))
    return mbd.System(
        bodies=[arm, bob],
        joints=[
            mbd.Revolute(GROUND.at(0.1, 0.1, 0.0), arm.at(-0.2, 0.0, 0.0), axis="y"),
            mbd.Drive(arm, GROUND, axis="y", angle=angle),
            mbd.Universal(arm.at(0.5, 0.0, 0.0), bob.at(), axes="yz"),
        ],
        gravity=(0.0, 0.0, -9.81),
    )


def guided() -> mbd.System:
    """A slider along a skew line, a wheel about its own origin and a fixed block, in a chain of massless links."""
    skew = [[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]]
    slider = body("slider", position=(0.8, 0.0, 0.6), velocity=(0.8, 0.0, 0.6))
    wheel = body("wheel", position=(0.0, 1.0, 0.0), angular_velocity=(0.0, 0.0, 2.0))
    block = body("block", position=(2.0, 0.0, 0.0))
    bob = body("bob", position=(2.0, 0.0, -1.0), angular_velocity=(0.5, 0.0, 0.0))
    return mbd.System(
        bodies=[slider, wheel, block, bob],
        joints=[
            mbd.Prismatic(GROUND.at(0.0, 0.0, 0.0, axes=skew), slider.at(), axis="x"),
            mbd.Revolute(GROUND.at(0.0, 1.0, 0.0), wheel.at(), axis="z"),
            mbd.DistanceJoint(wheel.at(0.3, 0.0, 0.0), slider.at(0.0, 0.1, 0.0), length=1.42**0.5),
            mbd.Fixed(GROUND.at(2.0, 0.0, 0.0), block.at()),
            mbd.Spherical(block.at(), bob.at(0.0, 0.0, 1.0)),
        ],
        gravity=(0.3, 0.0, -9.81),
    )


def compared(system: mbd.System, duration: float, steps: int, monkeypatch: pytest.MonkeyPatch, **options):
    result = mbd.simulate(system, duration, steps=steps, **TIGHT, **options)
    values = [result.q, result.v, result.a, result.lam]
    slopes = [result.dq_db, result.dv_db, result.dlam_db]
    with monkeypatch.context() as patch:
        whole(patch)
        expected = mbd.simulate(system, duration, steps=steps, **TIGHT, **options)
    whole_values = [expected.q, expected.v, expected.a, expected.lam]
    whole_slopes = [expected.dq_db, expected.dv_db, expected.dlam_db]
    assert all(x is not None for x in values)
    assert [x is None for x in slopes] == [x is None for x in whole_slopes]
    pairs = zip([*values, *slopes], [*whole_values, *whole_slopes], strict=True)
    return result, [(x, y) for x, y in pairs if x is not None]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "angle", [lambda t: 0.3 + 5.0 * t + 2.0 * torch.sin(9.0 * t), lambda t: -4.0 * t], ids=["wavy", "backwards"]
)
def test_a_driven_body_is_a_carrier(angle, monkeypatch):
    """The law does not start at zero or runs backwards; the drive names the moving body first."""
    system = driven(angle)
    assert [carrier.name for carrier in left(system).topology.prescribed_bodies] == ["arm"]
    assert left(system).topology.n_v + left(system).topology.rows == 6 + 4
    _, pairs = compared(system, 0.4, 400, monkeypatch)
    for x, expected in pairs:
        # Accelerations and multipliers of the whole start with an error of the method that fades (index 3).
        assert_close(x[:, 200:], expected[:, 200:], rtol=0, atol=2e-5 * float(expected.abs().max()))


@pytest.mark.thorough
def test_guided_bodies_keep_their_freedom_only(monkeypatch):
    system = guided()
    c = left(system)
    assert [carrier.name for carrier in c.topology.prescribed_bodies] == ["block"]
    assert (c.topology.n_v, c.topology.rows) == (1 + 1 + 6, 1 + 3)
    result, pairs = compared(system, 0.3, 300, monkeypatch)
    for x, expected in pairs:
        assert_close(x[:, 200:], expected[:, 200:], rtol=0, atol=2e-5 * float(expected.abs().max()))
    assert float(result.v.abs().max()) > 0.5


@pytest.mark.thorough
def test_the_slider_crank_with_all_its_sensitivities(monkeypatch):
    system = build(2, cells=(6, 2), modes=3)
    c = left(system)
    assert c.topology.names == ("rod", "slider")
    assert c.topology.n_v + c.topology.rows == 6 + 3 + 1 + 7
    _, pairs = compared(system, 0.02, 160, monkeypatch, gradients="forward")
    for x, expected in pairs:
        assert_close(x, expected, rtol=0, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.thorough
def test_the_jacobian_is_that_of_the_violations():
    system = build(3, cells=(4, 2), modes=2)
    T, poses = system.topology, _Poses(system.topology, 0.7)
    q = poses.moved(system.equations().initial.q, torch.linspace(-0.7, 0.9, T.n_v, dtype=torch.float64))
    expected = torch.func.jacfwd(lambda step: poses.phi(poses.moved(q, step)))(q.new_zeros(T.n_v))
    assert_close(poses.jacobian(q), expected, rtol=0, atol=1e-14)


def test_bodies_that_a_joint_does_not_hold_simply_stay():
    """A revolute joint away from the origin, a distance, a joint between two moving bodies: nothing constant to use."""
    a, b = body("a", position=(0.5, 0.0, 0.0)), body("b", position=(1.5, 0.0, 0.0))
    system = mbd.System(
        bodies=[a, b],
        joints=[
            mbd.Revolute(GROUND.at(), a.at(-0.5, 0.0, 0.0), axis="z"),
            mbd.Prismatic(a.at(0.5, 0.0, 0.0), b.at(-0.5, 0.0, 0.0), axis="x"),
        ],
    )
    assert condense(system.topology, system._initial.q, system._initial.size) is None


@pytest.mark.thorough
def test_redundant_rows_of_a_guided_body_share_the_reaction(monkeypatch):
    """Two prismatic joints on one slider: twice five rows, of rank five."""
    slider = body("slider")
    joints = [mbd.Prismatic(GROUND.at(y=y), slider.at(y=y), axis="x", name=f"guide{y}") for y in (0.0, 1.0)]
    system = mbd.System(bodies=[slider], joints=joints, gravity=(1.0, 0.0, -10.0))
    assert (left(system).topology.n_v, left(system).topology.rows) == (1, 0)
    motion = mbd.simulate(system, 0.1, steps=50).require_ok()
    assert_close(motion.body("slider").r[0, -1, 0], torch.tensor(0.005, dtype=torch.float64), rtol=1e-9, atol=0)
    dynamics, given = system.dynamics(), initial(system.dynamics())[0]
    assert motion.lam.shape[-1] == 10
    forces = motion.lam[0, -1, :, None, None]
    at = equations.placement(
        system.topology, dynamics.data, given.q, system.topology.prescribed(torch.zeros(()).double())
    )
    pull, turn, _ = equations.constraint_forces(system.topology, dynamics.data, at, forces)
    assert_close(pull[:, 0, 0, 0], torch.tensor([0.0, 0.0, -20.0], dtype=torch.float64), rtol=0, atol=1e-9)
    weight = torch.linalg.cross(slider.center, torch.tensor([0.0, 0.0, -20.0], dtype=torch.float64))
    assert_close(turn[:, 0, 0, 0], weight, rtol=0, atol=1e-9)


@pytest.mark.thorough
def test_multipliers_of_a_motion_that_failed():
    """Those of condensed joints are nan from the failure on, like everything else."""
    system = driven(lambda t: 2.0 * t)
    arm, bob = system.bodies

    def pull(t: torch.Tensor) -> torch.Tensor:
        return torch.sqrt(0.0555 - t) * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    motion = mbd.simulate(mbd.System([arm, bob], system.joints, [mbd.Force(bob.at(), pull)]), 0.1, steps=10)
    assert "not finite from t = 0.06 s on" in motion.status[0]
    assert bool(torch.isfinite(motion.lam[0, :6]).all())
    assert bool(torch.isnan(motion.lam[0, 6:]).any(1).all())


@pytest.mark.thorough
def test_removed_rows_of_each_lane_have_its_inertia():
    """A driven arm of two masses, whose hinge is removed: the hinge carries m (a - g) of its own lane at every time."""
    ground, speed, radius = mbd.Ground(), 3.0, 0.2
    driven = mbd.RigidBody("driven", mbd.variable(1.0), (1e-3,) * 3, position=(radius, 0.0, 0.0))
    bob = mbd.RigidBody("bob", 1.0, (1e-3,) * 3, position=(0.5, 0.0, 0.0))
    joints = [
        mbd.Revolute(ground.at(), driven.at(-radius, 0.0, 0.0), axis="z", name="hinge"),
        mbd.Drive(ground, driven, axis="z", speed=speed),
        mbd.Revolute(ground.at(0.3, 0.0, 0.0), bob.at(-0.2, 0.0, 0.0), axis="z", name="other"),
    ]
    system = mbd.System([driven, bob], joints, gravity=(0.0, -9.81, 0.0))
    mass = torch.tensor([1.0, 3.0], dtype=torch.float64)
    motion = mbd.simulate(system, 0.5, steps=20, designs={"driven.mass": mass}, gradients="none").require_ok()
    angle = speed * motion.t
    acceleration = -(speed**2) * radius * torch.stack([angle.cos(), angle.sin(), 0.0 * angle], -1)
    weight = torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64)
    expected = mass[:, None, None] * (acceleration - weight)
    assert_close(motion.reaction("hinge").force, expected, rtol=0, atol=1e-9)
