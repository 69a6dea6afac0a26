"""Mechanisms of MJCF files: accelerations against MuJoCo, connections, actuators, limits, flexible bodies."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused, warned

# Degrees, joints off the origins, several joints in a body, shapes, classes, frames, references, springs, actuators.
MECHANISM = """<mujoco model="all of it"><compiler eulerseq="zyx"/><option gravity="0.3 0 -9.7"/>
<default><joint damping="0.1"/><geom density="800"/>
  <default class="block"><geom type="box" size=".1 .05 .02"/><joint stiffness="3" springref="20"/></default></default>
<worldbody><geom type="plane" size="1 1 .1"/>
 <body name="a" pos="0 0 1" euler="10 20 30">
  <joint name="j1" axis="0 1 0.2" pos="0 .1 0" range="-90 120"/>
  <geom type="capsule" fromto="0 0 0 .3 .1 0" size=".03"/><geom size=".05" pos=".3 .1 0" mass=".2"/>
  <frame pos=".3 .1 0" axisangle="0 0 1 40">
   <body name="b" childclass="block" xyaxes="1 .1 0 0 1 .3">
    <joint name="j2" axis="1 0 0" ref="15"/><joint name="j3" type="slide" axis="0 1 1"/><joint name="j4" pos=".1 0 .2"/>
    <geom/><geom class="main" type="ellipsoid" size=".1 .05 .07" pos="0 .1 0" quat="1 .2 .3 .4"/>
    <geom class="main" type="cylinder" size=".02 .1" zaxis="1 2 3"/>
    <geom class="main" type="ellipsoid" size=".02 .1 .3" fromto="0 0 0 .1 .2 .3"/>
    <body name="c" pos=".2 0 0"><joint name="j5" axis="0 1 0"/>
     <inertial pos="0 .1 0" mass=".3" fullinertia=".01 .012 .015 .001 .002 -.001"/></body>
    <body name="d" pos="0 0 .2"><joint name="ball" type="ball" pos="0 0 .05" damping="0" stiffness="0"/>
     <geom type="box" size=".01 .02 .03" pos="0 0 .1"/></body>
    <body pos="0 0 .2"><geom type="box" size=".01 .02 .03" pos="0 0 .1"/></body></body></frame></body>
 <body name="f" pos="1 1 1"><freejoint/><geom type="cylinder" size=".1 .2"/>
  <body name="g" pos=".3 0 0"><joint name="j6"/><geom size=".1" pos=".1 0 0"/></body></body>
</worldbody>
<actuator><motor name="m1" joint="j1" gear="3" ctrlrange="-1 2"/><position name="p2" joint="j2" kp="7" kv=".3"/>
 <velocity name="v3" joint="j3" kv="2"/>
 <general name="g5" joint="j5" gainprm="3" biastype="affine" biasprm="1 -2 -.5" forcerange="-.1 .2"/></actuator></mujoco>"""
Q = {"j1": 0.4, "j2": -0.6, "j3": 0.05, "j4": 1.1, "j5": -0.3, "j6": 0.7}
RATE = {"j1": 1.2, "j2": -0.7, "j3": 0.2, "j4": 0.9, "j5": -1.4, "j6": 2.0}
CONTROLS = {"m1": 1.5, "p2": 0.3, "v3": -0.2, "g5": 0.4}
# MuJoCo 4.0.0: of each body's origin, in ground axes [m/s2], and of its angular velocity, in its axes [rad/s2].
ACCELERATIONS = {
    "a": ((0.65736707604, 0.382567884521, -0.577796374116), (0.0, 47.7373221497, 9.54746442994)),
    "b": ((-18.2359429996, 11.6599649876, -8.24614881557), (220.95780856, -384.829653019, 7.59713935189)),
    "c": ((4.06143616537, 2.30966185559, 65.0254978497), (215.159951145, 168.385670651, -59.4375069997)),
    "d": ((144.278056901, -64.1018198069, -68.3703743585), (-802.485552824, 1346.09370762, 0.0442211082311)),
    "f": ((0.204998391479, -0.00552701851738, -9.7), (0.0, 0.0, 3.64725246625)),
    "g": ((0.204998391479, 1.08864872136, -9.7), (0.0, 0.0, -10.6476944453)),
}


@pytest.fixture
def file(tmp_path):
    def written(text: str) -> Path:
        path = tmp_path / "mechanism.xml"
        path.write_text(text)
        return path

    return written


def assert_accelerations(motion, expected, **tolerances):
    """Compare accelerations of origins and rates of spins at the start, body by body."""
    for name, (place, spin) in expected.items():
        view = motion.body(name)
        result = view.at((0.0, 0.0, 0.0)).acceleration[0, 0].numpy(), view.omega_rate[0, 0].numpy()
        np.testing.assert_allclose(result[0], place, **tolerances)
        np.testing.assert_allclose(result[1], spin, **tolerances)


@pytest.mark.thorough
def test_bodies_accelerate_as_in_mujoco(file):
    given = {"positions": Q, "velocities": RATE, "controls": CONTROLS}
    with pytest.warns(UserWarning, match="left out: contact between geoms$"):
        system = mbd.io.read_mjcf(file(MECHANISM), stop_stiffness=None, **given)
    motion = mbd.simulate(system, 1e-6, steps=1, gradients="none", backend="eager")
    assert_accelerations(motion, ACCELERATIONS, rtol=1e-11, atol=1e-9)


def test_the_force_of_an_actuator_ends_at_its_limits():
    """The last one of the mechanism above: 3 u + 1 - 2 s - s' / 2 between -0.1 and 0.2; a control of time within its range."""
    from torchmbd.extensions.robots.forces import ActuatorLaw
    from torchmbd.extensions.robots.tree import Actuator

    s, rate, t = (torch.tensor(x, dtype=torch.float64) for x in (0.4, 0.2, 0.5))
    own = Actuator("g", "j", 2.0, 3.0, (1.0, -2.0, -0.5), (-1.0, 1.0), None)
    assert float(ActuatorLaw(0.1, own)(s, rate, t)) == pytest.approx(2.0 * (0.3 + 1.0 - 1.6 - 0.2))
    assert float(ActuatorLaw(lambda t: 4.0 * t, own)(s, rate, t)) == pytest.approx(2.0 * (3.0 + 1.0 - 1.6 - 0.2))


PENDULUM = """<mujoco><option><flag contact="disable"/></option><worldbody>
<body name="bar" pos="0 0 2"><joint name="hinge" axis="0 1 0" {joint}/>
<geom type="box" size=".5 .01 .01" pos=".5 0 0" mass="3"/></body>
{other}</worldbody>{equality}{actuator}</mujoco>"""


def pendulum(file, joint: str = "", other: str = "", equality: str = "", actuator: str = "") -> Path:
    parts = {"joint": joint, "other": other, "equality": equality, "actuator": actuator}
    return file(PENDULUM.format(**parts))


@pytest.mark.filterwarnings("error")
def test_a_bar_falls(file):
    """m g l / J about the hinge, J = m (l^2 / 3 + thickness^2 / 3)."""
    system = mbd.io.read_mjcf(pendulum(file))
    motion = mbd.simulate(system, 1e-6, steps=1, gradients="none", backend="eager")
    inertia = 3.0 / 3.0 * (0.5**2 + 0.01**2) + 3.0 * 0.5**2
    assert float(motion.body("bar").omega_rate[0, 0, 1]) == pytest.approx(3.0 * 9.81 * 0.5 / inertia, rel=1e-12)


def test_springs_limits_and_references(file):
    """Degrees; a stop; the pose of the file is that of `ref`."""
    path = pendulum(file, 'stiffness="4" damping="1" springref="30" range="-45 90" ref="60" frictionloss="0.2"')
    system = mbd.io.read_mjcf(path)
    assert [force.name for force in system.forces] == ["hinge_spring", "hinge_friction", "hinge_stop"]
    torch.testing.assert_close(system.body("bar").axes, torch.eye(3, dtype=torch.float64))
    spring = system.forces[0]
    assert (spring.law.stiffness, spring.law.damping) == (4.0, 1.0)
    assert spring.law.rest == pytest.approx(math.pi / 6.0)
    with refused("positions"):
        mbd.io.read_mjcf(path, positions={"hinge": 2.0})


@pytest.mark.thorough
def test_connections_close_loops_where_the_file_has_its_bodies(file):
    """A bar held at its tip by another: both stay; so does a welded one."""
    foot = '<joint name="foot" axis="0 1 0"/>'
    other = f'<body name="strut" pos="1 0 0">{foot}<geom type="capsule" fromto="0 0 0 0 0 2" size=".01"/></body>'
    for equality, kind in (
        ('<connect name="top" body1="bar" body2="strut" anchor="1 0 0"/>', mbd.Spherical),
        ('<weld name="top" body1="bar" body2="strut"/>', mbd.Fixed),
    ):
        system = mbd.io.read_mjcf(pendulum(file, "", other, f"<equality>{equality}</equality>"))
        joint = system.joints[-1]
        assert (type(joint), joint.name) == (kind, "top")
        motion = mbd.simulate(system, 0.1, steps=10, gradients="none", backend="eager").require_ok()
        assert float(motion.body("bar").omega.abs().max()) < 1e-9
    held = mbd.io.read_mjcf(pendulum(file, "", other, '<equality><joint joint1="hinge"/></equality>'))
    assert [body.name for body in held.bodies] == ["strut"]  # without a second joint it stays


# An arm with two fingers that follow each other, and a tip that follows its finger.
GRIPPER = """<mujoco><option gravity="0.3 0.5 -9.81"><flag contact="disable"/></option><worldbody>
<body name="arm" pos="0 0 1" euler="10 20 30"><joint name="wrist" axis="0 1 0.2"/>
 <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
 <body name="left" pos=".3 .05 0"><joint name="l" axis="0 0 1" ref="10"/><geom type="box" size=".1 .02 .01" pos=".1 0 0"/>
  <body name="tip" pos=".2 0 0"><joint name="t" axis="0 0 1"/><geom type="box" size=".05 .02 .01" pos=".05 0 0"/></body></body>
 <body name="right" pos=".3 -.05 0"><joint name="r" axis="0 0 1"/><geom type="box" size=".1 .02 .015" pos=".1 0 0"/></body>
 </body>
</worldbody><equality><joint joint1="r" joint2="l" polycoef="0.02 -1 0 0 0"/>
<joint joint1="t" joint2="l" polycoef="0 -0.7 0 0 0"/></equality>
<actuator><motor name="m" joint="l" gear="1"/></actuator></mujoco>"""
# N (N' M N)^-1 N' f with masses M and forces f of MuJoCo 4.0.0, the columns of N the motions that the equalities leave: its
# limit of hard equalities. Of each body's origin, and of its angular velocity, as above.
HARD = {
    "left": ((-4.40632617192, 0.139347561442, -3.72915877437), (5.20210706348, 18.1138084253, 19.4986681552)),
    "tip": ((-9.49939457951, 1.77881251977, -4.5231436942), (1.57763683727, 18.7618078974, 8.48527421629)),
    "right": ((-4.20364958526, 0.377084128664, -3.94067138506), (-4.8388146595, 18.2142209897, -11.9681716703)),
}


@pytest.mark.thorough
def test_a_gripper_moves_as_the_hard_limit_of_mujoco(file):
    start = {"positions": {"wrist": 0.4, "l": 0.5}, "velocities": {"wrist": 1.1, "l": -0.8}}
    system = mbd.io.read_mjcf(file(GRIPPER), controls={"m": 0.3}, **start)
    assert system.describe().freedoms == 2
    motion = mbd.simulate(system, 1e-6, steps=1, gradients="none", backend="eager")
    assert_accelerations(motion, HARD, rtol=1e-10, atol=1e-10)


@pytest.mark.thorough
def test_equalities_of_joints(file):
    """Two fingers that slide up and down, the second -2 times as the first, with references and a motor: closed form."""
    text = """<mujoco><option gravity="0 0 -9.81"><flag contact="disable"/></option><worldbody>
    <body name="one" pos="0 0 1"><joint name="up" type="slide" axis="0 0 1" ref="0.1"/><geom size=".1" mass="2"/></body>
    <body name="two" pos="1 0 1"><joint name="down" type="slide" axis="0 0 1" ref="0.05"/><geom size=".1" mass="3"/></body>
    </worldbody><equality><joint joint1="down" joint2="up" polycoef="{}"/></equality>
    <actuator><motor name="lift" joint="up" gear="5"/></actuator></mujoco>"""
    system = mbd.io.read_mjcf(file(text.format("0.02 -2 0 0 0")), positions={"up": 0.3}, controls={"lift": 4.0})
    assert float(system.body("two").position[2]) == pytest.approx(1.0 + 0.02 - 2.0 * 0.2)
    motion = mbd.simulate(system, 0.1, steps=10, gradients="none", backend="eager").require_ok()
    acceleration = (20.0 - 9.81 * (2.0 - 2.0 * 3.0)) / (2.0 + 4.0 * 3.0)
    for name, factor in (("one", 1.0), ("two", -2.0)):
        way = motion.body(name).r[0, -1, 2] - motion.body(name).r[0, 0, 2]
        assert float(way) == pytest.approx(factor * 0.5 * acceleration * 0.1**2, rel=1e-10)
    for coefficients, path in (
        ("0 1 0.5 0 0", "mechanism.xml, <joint> 'joint_1'.polycoef"),
        ("0 one", "mechanism.xml, <joint> 'joint_1'.polycoef"),
    ):
        with refused(path):
            mbd.io.read_mjcf(file(text.format(coefficients)))


@pytest.mark.thorough
@pytest.mark.filterwarnings("error")
def test_controls_and_drives(file):
    """A position actuator whose control is zero holds the bar near zero; its control may be a function of time."""
    text = '<actuator><position name="servo" joint="hinge" kp="500" kv="40" ctrlrange="0.1 1"/></actuator>'
    path = pendulum(file, actuator=text)
    [servo] = mbd.io.read_mjcf(path).forces
    zero = torch.zeros((), dtype=torch.float64)
    assert float(servo.law(zero, zero, zero)) == pytest.approx(500.0 * 0.1)  # zero is below its range
    held = mbd.io.read_mjcf(path, controls={"servo": 0.5})
    assert float(held.forces[0].law(zero + 0.5, zero, zero)) == 0.0
    moved = mbd.io.read_mjcf(path, controls={"servo": lambda t: 0.2 + t})
    assert float(moved.forces[0].law(zero, zero, zero + 0.3)) == pytest.approx(250.0)
    assert [joint.name for joint in mbd.io.read_mjcf(path, drives={"hinge": lambda t: 2.0 * t}).joints] == [
        "hinge",
        "hinge_drive",
    ]
    for given, argument in (({"servo": 2.0}, "controls.servo"), ({"motor": 1.0}, "controls.motor")):
        with refused(argument):
            mbd.io.read_mjcf(path, controls=given)


@pytest.mark.thorough
def test_bodies_may_be_flexible(file):
    """Its mass is at the nodes: of 16 elements 0.2 % too much inertia about the end."""
    steel = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=4e-4, Iyy=1.3e-8, Izz=1.3e-8, J=2.2e-8)
    beam = mbd.FlexibleBody.beam(
        "bar",
        mbd.BeamLine.straight(1.0, 16),
        steel,
        damping=1e-3,
        modes=2,
        reference="start",
        reduction="craig-bampton",
        interface=["end"],
    )
    system = mbd.io.read_mjcf(pendulum(file), flexible={"bar": beam})
    assert system.bodies[0] is beam
    bent = mbd.simulate(system, 0.1, steps=50, gradients="none").body("bar").at("end").position
    rigid = mbd.io.read_mjcf(pendulum(file))
    straight = mbd.simulate(rigid, 0.1, steps=50, gradients="none").body("bar").at((1.0, 0.0, 0.0)).position
    assert float(straight[0, -1, 2]) < 1.94
    torch.testing.assert_close(bent[0, -1], straight[0, -1], rtol=0.0, atol=2e-4)


@pytest.mark.parametrize(
    ("words", "freedoms"),
    [
        ('<default><joint limited="true"/></default>', 6),
        ('<default><joint limited="true" range="1 2"/></default>', 6),
        ("", 6),
    ],
)
def test_limits_do_not_concern_free_joints(file, words, freedoms):
    bodies = '<body name="b"><joint type="free"/><geom size=".1"/></body>'
    path = file(f'<mujoco><option><flag contact="disable"/></option>{words}<worldbody>{bodies}</worldbody></mujoco>')
    assert mbd.io.read_mjcf(path).describe().freedoms == freedoms


def test_a_ball_joint_may_be_limited_without_a_range(file):
    body = '<body name="b"><joint type="ball" limited="true"/><geom size=".1"/></body>'
    path = file(f'<mujoco><option><flag contact="disable"/></option><worldbody>{body}</worldbody></mujoco>')
    assert mbd.io.read_mjcf(path).describe().freedoms == 3


@pytest.mark.parametrize("kind", ["free", "ball"])
def test_damping_of_joints_of_several_coordinates_is_listed(file, kind):
    body = f'<body name="b"><joint name="j" type="{kind}" damping="1"/><geom size=".1"/></body>'
    path = file(f'<mujoco><option><flag contact="disable"/></option><worldbody>{body}</worldbody></mujoco>')
    with warned(f"{kind} joints ['j']"):
        mbd.io.read_mjcf(path)


@pytest.mark.parametrize(
    ("words", "s", "rate", "force"),
    [  # MuJoCo 4.0.0: dampers are odd, springs are not
        ('damping="2 0 0"', 0.3, 0.5, -1.0),
        ('damping="1 2 3"', 0.3, 1.0, -6.0),
        ('damping="1 2 3"', 0.3, -1.0, 6.0),
        ('damping="0 2"', 0.3, -2.0, 8.0),
        ('stiffness="1 2 3"', 2.0, 0.0, -(2.0 + 2.0 * 4.0 + 3.0 * 8.0)),
        ('stiffness="1 2 3"', -2.0, 0.0, -(-2.0 + 2.0 * 4.0 - 3.0 * 8.0)),
        ('stiffness="0 0 4" damping="1" springref="90"', 1.0, 0.5, -4.0 * (1.0 - math.pi / 2.0) ** 3 - 0.5),
    ],
)
def test_springs_and_dampers_may_be_polynomials(file, words, s, rate, force):
    [element] = mbd.io.read_mjcf(pendulum(file, words)).forces
    s, rate, t = (torch.tensor(x, dtype=torch.float64) for x in (s, rate, 0.0))
    assert element.law(s, rate, t).item() == pytest.approx(force, rel=1e-12)


def test_a_polynomial_of_four_terms_is_refused(file):
    with refused("mechanism.xml, joint 'hinge'.damping", "1 2 3 4"):
        mbd.io.read_mjcf(pendulum(file, 'damping="1 2 3 4"'))
