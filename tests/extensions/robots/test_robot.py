"""Robots of URDF files: motion against a recursion of Newton and Euler, fixed links, limits, damping, friction, plates."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import torchmbd as mbd
from experiments.peers.newton_euler import Tree
from tests.mechanisms import finished, laminate
from tests.refused import ANY, refused, warned
from torchmbd.extensions.robots.tree import Pose
from torchmbd.extensions.robots.urdf import urdf_robot

INERTIAL = (
    '<inertial><origin xyz="{at}" rpy="{turn}"/><mass value="{m}"/>'
    '<inertia ixx="{a}" iyy="{b}" izz="{c}" ixy="{d}" ixz="0" iyz="{e}"/></inertial>'
)


def link(
    name: str, m: float, at: str, a: float, b: float, c: float, d: float = 0.0, e: float = 0.0, turn: str = "0 0 0"
):
    return f'<link name="{name}">{INERTIAL.format(at=at, m=m, a=a, b=b, c=c, d=d, e=e, turn=turn)}</link>'


def joint(
    name: str, kind: str, parent: str, child: str, xyz: str, rpy: str = "0 0 0", axis: str = "0 0 1", extra: str = ""
):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{extra}</joint>'
    )


ARM = [
    '<link name="world"/>',
    link("link1", 2.0, "0 0 0.12", 0.0061, 0.0061, 0.011),
    link("link2", 0.3935, "0.25 0.01 0", 1.9e-4, 8.3e-3, 8.2e-3, 1e-5, -2e-5, "0.1 0.2 -0.3"),
    link("link3", 0.4, "0.25 0 0.02", 1.9e-4, 8.3e-3, 8.2e-3),
    '<link name="flange"/>',
    link("load", 0.2, "0.025 0 0.01", 1e-4, 2e-4, 2e-4),
    joint(
        "j1",
        "revolute",
        "world",
        "link1",
        "0 0 0",
        extra='<limit lower="-3.14159" upper="3.14159"/>',
    ),
    joint("j2", "revolute", "link1", "link2", "0 0 0.15", "1.57 0 0", extra='<limit lower="-2" upper="2"/>'),
    joint(
        "j3",
        "continuous",
        "link2",
        "link3",
        "0.5 0 0",
        "0.2 0.1 0",
        "0.6 0 0.8",
        '<dynamics damping="0.3" friction="0"/>',
    ),
    joint("f1", "fixed", "link3", "flange", "0.5 0 0", "0 0 0.4"),
    joint("f2", "fixed", "flange", "load", "0.01 0 0", "0.3 0 0"),
]
Q = {"j1": 0.3, "j2": -0.7, "j3": 1.1}
RATE = {"j1": 1.5, "j2": -2.0, "j3": 0.8}
MOVING = ["j1", "j2", "j3"]


@pytest.fixture
def file(tmp_path):
    def written(*lines: str, name: str = "robot.urdf") -> Path:
        path = tmp_path / name
        path.write_text('<?xml version="1.0"?>\n<robot name="arm">\n' + "\n".join(lines) + "\n</robot>\n")
        return path

    return written


def turned(axis, angle):
    K = np.cross(np.eye(3), axis).T
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


@pytest.mark.thorough
def test_an_arm_of_three_joints_follows_the_recursion(file):
    """Angular accelerations of all links at 1e-10, at the start and along a motion; links fixed to others are parts of them."""
    path = file(*ARM)
    with warned("joints ['j1']", "turn"):
        system = mbd.io.read_urdf(path, positions=Q, velocities=RATE)
    assert [body.name for body in system.bodies] == ["link1", "link2", "link3"]
    assert system.describe().freedoms == 3
    motion = finished(mbd.simulate(system, 1e-3, steps=10, gradients="none"))
    _, expected = Tree(path).accelerations(Q, RATE)
    for name in ("link1", "link2", "link3"):
        result, own = motion.body(name).omega_rate[0, 0].numpy(), expected[name][1]
        np.testing.assert_allclose(result, own, rtol=1e-10, atol=1e-10 * abs(own).max())


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled")
def test_the_motion_converges_to_that_of_the_recursion(file):
    """Positions after 0.1 s against steps of Runge and Kutta on the recursion."""
    path = file(*ARM)
    system = mbd.io.read_urdf(path, positions=Q, velocities=RATE, stop_stiffness=None)
    motion = finished(mbd.simulate(system, 0.1, steps=400, gradients="none"))
    robot, tree, h = urdf_robot(path), Tree(path), 2e-3
    y = np.array([[x[name] for name in MOVING] for x in (Q, RATE)])

    def f(y):
        q, rate = (dict(zip(MOVING, x, strict=True)) for x in y)
        return np.stack([y[1], tree.accelerations(q, rate)[0]])

    for _ in range(50):
        a = f(y)
        b = f(y + h / 2 * a)
        c = f(y + h / 2 * b)
        y = y + h / 6 * (a + 2 * b + 2 * c + f(y + h * c))
    pose = Pose(np.zeros(3), np.eye(3))
    for j, angle in zip([j for j in robot.joints if j.kind != "fixed"], y[0], strict=True):
        pose = pose @ j.origin @ Pose(np.zeros(3), turned(j.axis, angle))
    tip = motion.body("link3").r[0, -1].numpy()
    np.testing.assert_allclose(tip, pose.position, atol=2e-5)


PENDULUM = [
    '<link name="world"/>',
    link("rod", 1.0, "0.5 0 0", 1e-3, 0.1, 0.1),
]


def hinge(extra: str = "", kind: str = "revolute", axis: str = "0 1 0") -> str:
    return joint("hinge", kind, "world", "rod", "0 0 0", axis=axis, extra=extra)


@pytest.mark.thorough
def test_limits_are_stops_and_friction_takes_energy(file):
    """A pendulum falls on its stop: as deep as its energy tells. Without gravity friction slows it down by F / J t."""
    stop = file(*PENDULUM, hinge('<limit lower="-1" upper="0.4"/><dynamics damping="0.1"/>'))
    motion = finished(mbd.simulate(mbd.io.read_urdf(stop), 0.35, steps=350, gradients="none"))
    x = motion.body("rod").A[0, :, :, 0]
    angle = torch.atan2(-x[:, 2], x[:, 0])
    depth = math.sqrt(2.0 * 9.81 * 0.5 * math.sin(0.4) / 1e4)
    assert 0.4 + 0.9 * depth < float(angle.max()) < 0.4 + 1.02 * depth
    assert float(angle[-1]) < 0.4
    J = 0.1 + 0.25
    rough = file(*PENDULUM, hinge('<dynamics friction="0.7"/>', "continuous", "0 0 1"), name="rough.urdf")
    system = mbd.io.read_urdf(rough, gravity=None, velocities={"hinge": 3.0})
    motion = finished(mbd.simulate(system, 0.5, steps=500, gradients="none"))
    assert float(motion.body("rod").omega[0, -1, 2]) == pytest.approx(3.0 - 0.7 / J * 0.5, rel=1e-6)


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled")
def test_stops_are_watched_and_may_lose_energy(file):
    """Steps that a stop is too short for are halved; with damping the speed after it is that of Hunt and Crossley's law."""
    stop = file(*PENDULUM, hinge('<limit lower="-0.1" upper="0.1"/>', axis="0 0 1"))
    given = {"gravity": None, "velocities": {"hinge": 0.5}, "stop_stiffness": 1e5}
    system = mbd.io.read_urdf(stop, **given)
    assert [type(force) for force in system.forces] == [mbd.RotationalStop]
    motion = finished(mbd.simulate(system, 0.3, steps=30, gradients="none"))
    assert motion.stats["halved"] == [0]
    assert float(motion.body("rod").omega[0, -1, 2]) == pytest.approx(-0.5, rel=1e-3)
    c, v = 0.6, 0.5
    soft = mbd.io.read_urdf(stop, **given | {"stop_stiffness": 3e3, "stop_damping": c})
    w = -float(finished(mbd.simulate(soft, 0.3, steps=1000, gradients="none")).body("rod").omega[0, -1, 2])
    assert c * v - math.log1p(c * v) == pytest.approx(-c * w - math.log1p(-c * w), rel=1e-4)


def test_starts_beyond_limits_are_refused(file):
    path = file(*PENDULUM, hinge('<limit lower="0.2" upper="0.4"/>'))
    with refused("positions"):
        mbd.io.read_urdf(path)
    assert mbd.io.read_urdf(path, positions={"hinge": 0.3}).forces
    assert not mbd.io.read_urdf(path, stop_stiffness=None).forces
    effort = file(*PENDULUM, hinge('<limit effort="3" velocity="1"/>'))
    assert not mbd.io.read_urdf(effort).forces  # a <limit> without lower and upper


def mimicking(attributes: str) -> list[str]:
    """The arm, whose joint j3 mimics another."""
    lines = [line.replace('"continuous"', '"revolute"') for line in ARM]
    lines[8] = lines[8].replace("<axis", f"<mimic {attributes}/><axis")
    return lines


@pytest.mark.thorough
def test_a_joint_that_mimics_another_follows_it(file):
    """As the recursion with three coordinates, whose equations are those of the two that remain: N' M N a = -N' h."""
    path = file(*mimicking('joint="j2" multiplier="-1.5" offset="0.2"'))
    Q, rate = {"j1": 0.3, "j2": -0.7}, {"j1": 1.5, "j2": -2.0}
    system = mbd.io.read_urdf(path, positions=Q, velocities=rate, stop_stiffness=None)
    assert [(joint.name, type(joint)) for joint in system.joints][-1] == ("j3_mimic", mbd.JointCoupling)
    assert system.describe().freedoms == 2
    motion = finished(mbd.simulate(system, 1e-3, steps=2, gradients="none", backend="eager"))
    tree, places = Tree(path), Q | {"j3": 0.2 - 1.5 * Q["j2"]}
    speeds, still = np.array([1.5, -2.0, 3.0]), np.zeros(3)
    M = np.stack([tree._recursion(places, still, e, 0.0)[0] for e in np.eye(3)], axis=1)
    forces = -tree._recursion(places, speeds, still, 9.81)[0] - np.array([0.0, 0.0, 0.3]) * speeds
    N = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.5]])
    links = tree._recursion(places, speeds, N @ np.linalg.solve(N.T @ M @ N, N.T @ forces), 9.81)[1]
    for name in ("link1", "link2", "link3"):
        result, spin = motion.body(name).omega_rate[0, 0].numpy(), links[name][1]
        np.testing.assert_allclose(result, spin, rtol=1e-10, atol=1e-10 * abs(spin).max())


@pytest.mark.thorough
def test_a_follower_of_a_locked_joint_is_fixed(file):
    path = file(*mimicking('joint="j2" multiplier="-1.5" offset="0.2"'))
    system = mbd.io.read_urdf(path, positions={"j2": 0.4}, locked=["j2"], stop_stiffness=None)
    expected = mbd.io.read_urdf(
        file(*ARM, name="plain.urdf"), positions={"j2": 0.4, "j3": -0.4}, locked=["j2", "j3"], stop_stiffness=None
    )
    assert [body.name for body in system.bodies] == ["link1"]
    torch.testing.assert_close(system.body("link1").inertia, expected.body("link1").inertia, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("attributes", "given", "fault"),
    [
        ('joint="j9"', {}, ("joints.j3", ANY, "'j9'")),
        ('joint="f1"', {}, ("joints.j3", ANY, "'f1'")),
        ('joint="j3"', {}, ("joints.j3", ANY, "loop")),
        ("", {}, ("robot.urdf, joint 'j3'.mimic",)),
        (
            'joint="j2"',
            {"positions": {"j2": 0.1, "j3": 0.2}},
            ("positions.j3", 0.2),
        ),
        ('joint="j2"', {"velocities": {"j3": 0.2}}, ("velocities.j3", 0.2)),
        ('joint="j2" multiplier="fast"', {}, ("robot.urdf, joint 'j3'.multiplier", "fast")),
    ],
)
def test_relations_that_cannot_be_kept_are_refused(file, attributes, given, fault):
    with refused(*fault):
        mbd.io.read_urdf(file(*mimicking(attributes)), stop_stiffness=None, **given)


@pytest.mark.thorough
def test_locked_joints_are_fixed_at_their_positions(file):
    """As if the position stood in the file; a joint that mimics another may be."""
    path, rate = file(*mimicking('joint="j2"')), {"j1": 1.5, "j2": -2.0}
    system = mbd.io.read_urdf(path, positions=Q, velocities=rate, locked=["j3"])
    assert [body.name for body in system.bodies] == ["link1", "link2"]
    once = mbd.io.read_urdf(path, positions=Q, velocities=rate, locked=(name for name in ["j3"]))
    assert [body.name for body in once.bodies] == ["link1", "link2"]
    motion = finished(mbd.simulate(system, 1e-3, steps=10, gradients="none"))
    _, expected = Tree(path, ["j3"]).accelerations(Q, rate)
    np.testing.assert_allclose(motion.body("link2").omega_rate[0, 0], expected["link2"][1], rtol=1e-10)


@pytest.mark.thorough
def test_drives_move_joints_from_their_positions(file):
    system = mbd.io.read_urdf(
        file(*PENDULUM, hinge()), positions={"hinge": 0.3}, drives={"hinge": mbd.SmoothStep(0.5, 0.2)}, gravity=None
    )
    motion = finished(mbd.simulate(system, 0.3, steps=30, gradients="none"))
    assert float(motion.body("rod").A[0, -1, 2, 0]) == pytest.approx(-math.sin(0.8), abs=1e-9)
    assert "hinge_drive" in [joint.name for joint in system.joints]
    slide = file(*PENDULUM, hinge(kind="prismatic"))
    system = mbd.io.read_urdf(slide, drives={"hinge": mbd.SmoothStep(0.5, 0.2)})
    motion = finished(mbd.simulate(system, 0.3, steps=30, gradients="none"))
    assert float(motion.body("rod").r[0, -1, 1]) == pytest.approx(0.5, abs=1e-9)


def test_inertia_that_no_mass_has_is_taken_with_a_warning(file):
    path = file(PENDULUM[0], link("rod", 1.0, "0.5 0 0", 1e-3, 0.1, 0.3), hinge())
    with warned("links ['rod']", "principal inertia"):
        system = mbd.io.read_urdf(path, velocities={"hinge": 1.0})
    motion = finished(mbd.simulate(system, 1e-3, steps=10, gradients="none"))
    np.testing.assert_allclose(
        motion.body("rod").omega_rate[0, 0], Tree(path).accelerations({}, {"hinge": 1.0})[1]["rod"][1], rtol=1e-12
    )
    with refused("links.rod.inertia"):
        mbd.io.read_urdf(file(PENDULUM[0], link("rod", 1.0, "0 0 0", -1e-3, 0.1, 0.1), hinge()))


@pytest.mark.thorough
def test_slides_and_free_bases(file):
    """A prismatic joint along a direction, damped; a base that is not fixed falls."""
    path = file(*PENDULUM, hinge('<dynamics damping="2"/><limit lower="0" upper="0"/>', "prismatic", "0 0.6 0.8"))
    system = mbd.io.read_urdf(path, gravity=None, velocities={"hinge": 1.0}, stop_stiffness=None)
    motion = finished(mbd.simulate(system, 0.5, steps=500, gradients="none"))
    along = motion.body("rod").r[0, -1] @ torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    assert float(along) == pytest.approx((1.0 - math.exp(-1.0)) / 2.0, rel=1e-5)
    base = [link("world", 3.0, "0 0 0", 1.0, 1.0, 1.0), PENDULUM[1], hinge()]
    system = mbd.io.read_urdf(file(*base), fixed_base=False)
    assert system.describe().freedoms == 7
    motion = finished(mbd.simulate(system, 0.1, steps=50, gradients="none"))
    assert float(motion.body("world").r[0, -1, 2]) == pytest.approx(-0.5 * 9.81 * 0.01, rel=1e-3)


@pytest.mark.thorough
def test_a_link_is_replaced_by_a_plate(file):
    """Link 2 as a laminated plate in its frame: joints sit on its edges, and its angles are design variables."""
    mesh = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(4, 1))
    mesh = mbd.Mesh(
        mesh.nodes + torch.tensor([0.25, 0.0, 0.0], dtype=torch.float64), quads=mesh.quads, node_sets=mesh.node_sets
    )
    plate = mbd.FlexibleBody.plate("plate", mesh, laminate((30.0, -50.0)), modes=2, reference=0)
    system = mbd.io.read_urdf(file(*ARM), flexible={"link2": plate}, stop_stiffness=None, positions=Q)
    assert [body.name for body in system.bodies] == ["link1", "plate", "link3"]
    assert system.describe().freedoms == 3 + plate.modes
    assert "plate.laminate.angles" in dict(system.named_parameters())
    motion = finished(mbd.simulate(system, 1e-3, steps=10, gradients="none"))
    rigid = mbd.io.read_urdf(file(*ARM), stop_stiffness=None, positions=Q)
    same = mbd.simulate(rigid, 1e-3, steps=10, gradients="none")
    torch.testing.assert_close(motion.body("link3").r[0, 0], same.body("link3").r[0, 0], rtol=0.0, atol=2e-3)
    far = mbd.FlexibleBody.plate("plate", mbd.mesh.rectangle(0.2, 0.05, (2, 1)), laminate((30.0,)), modes=2)
    with refused("j3"):
        mbd.io.read_urdf(file(*ARM), flexible={"link2": far})


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ({"flexible": {"link9": None}}, "flexible.link9"),
        ({"positions": {"j9": 1.0}}, "positions.j9"),
        ({"positions": {"j1": "x"}}, "positions['j1']"),
        ({"velocities": [1.0]}, "velocities"),
        ({"flexible": {"link2": 3}}, "flexible.link2"),
        ({"fixed_base": 1}, "fixed_base"),
        ({"stop_stiffness": -1.0}, "stop_stiffness"),
        ({"stop_damping": -1.0}, "j2_stop.damping"),
        ({"locked": "j1"}, "locked"),
        ({"locked": ["f1"]}, "locked.f1"),
        ({"locked": ["j1"], "velocities": {"j1": 1.0}}, "velocities.j1"),
        ({"friction_speed": 0.0, "positions": {}}, "friction_speed"),
    ],
)
def test_wrong_arguments_are_named(file, given, path):
    extra = joint("j4", "revolute", "link3", "hook", "1 0 0", extra='<dynamics friction="1"/>')
    with refused(path):
        mbd.io.read_urdf(file(*ARM, link("hook", 1.0, "0 0 0", 1e-3, 1e-3, 1e-3), extra), **given)


def test_inertia_without_mass_counts(tmp_path):
    """Of a link that is fixed to another one: files of robots have such feet."""
    file = tmp_path / "foot.urdf"
    file.write_text(
        '<robot name="leg"><link name="base"/>'
        + link("leg", 1.0, "0 0 0", 1e-3, 2e-3, 3e-3)
        + link("foot", 0.0, "0 0 0", 1e-3, 2e-3, 3e-3)
        + joint("hip", "revolute", "base", "leg", "0 0 0", "0 0 0")
        + joint("ankle", "fixed", "leg", "foot", "0.3 0 0", "0 0 0")
        + "</robot>"
    )
    [leg] = mbd.io.read_urdf(file).bodies
    assert leg.inertia.diagonal().tolist() == pytest.approx([2e-3, 4e-3, 6e-3])
