"""MJCF files that are broken: named by file and element; spoilt files; includes; shapes; what is left out."""

from __future__ import annotations

import random
import warnings

import numpy as np
import pytest

import torchmbd as mbd
from tests.extensions.robots.test_robot_mjcf import MECHANISM
from tests.refused import ANY, refused, warned
from torchmbd.errors import InputError
from torchmbd.extensions.robots.mjcf import mjcf_robot

HEAD, TAIL = "<mujoco><worldbody>", "</worldbody></mujoco>"


@pytest.fixture
def file(tmp_path):
    def written(text: str, name: str = "arm.xml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('type="slide"', 'type="screw"', "joint 'j3': type = 'screw'"),
        ('name="j5" axis="0 1 0"', 'name="j5" axis="0 0 0"', "joint 'j5': axis = '0 0 0'"),
        ('name="j5" axis="0 1 0"', 'name="j4"', "joint 'j4' appears twice"),
        ('name="c"', 'name="b"', "body 'b' appears twice"),
        ('mass=".3"', 'mass="-1"', "body 'c', inertial: mass = -1"),
        ('mass=".3"', 'mass="nan"', "inertial: mass = 'nan'"),
        ('mass=".3"', "", "inertial: mass = ''"),
        ('fullinertia=".01 .012 .015 .001 .002 -.001"', 'fullinertia="1 2"', "must be 6 numbers"),
        ('range="-90 120"', 'range="9 1" limited="true"', "range = '9 1'"),
        ('damping="0.1"', 'damping="-0.1"', "damping, frictionloss, stiffness"),
        ('class="main" type="cylinder" size=".02 .1"', 'class="main" type="cylinder" size=".02"', "2 positive numbers"),
        ('class="main" type="cylinder"', 'class="main" type="mesh"', "type 'mesh' gives no inertia here"),
        ('class="main" type="cylinder"', 'class="main" shellinertia="true" type="cylinder"', "shellinertia = 'true'"),
        ('childclass="block"', 'childclass="blocks"', "class = 'blocks': must be "),
        ('quat="1 .2 .3 .4"', 'quat="0 0 0 0"', "quat = '0 0 0 0'"),
        ('zaxis="1 2 3"', 'zaxis="0 0 0"', "zaxis = '0 0 0'"),
        ('xyaxes="1 .1 0 0 1 .3"', 'xyaxes="1 0 0 2 0 0"', "xyaxes = "),
        ('eulerseq="zyx"', 'eulerseq="abc"', "eulerseq = 'abc'"),
        ('eulerseq="zyx"', 'coordinate="global"', "coordinate = 'global'"),
        ("<freejoint/>", '<freejoint/><joint name="k"/>', "a free joint among others"),
        ('joint="j5" gainprm', 'joint="j55" gainprm', "joint = 'j55': must be "),
        ('gear="3"', 'gear=""', "gear = ''"),
        ('<option gravity="0.3 0 -9.7"/>', '<option><flag spring="disable"/></option>', "flag spring"),
        ("<freejoint/>", '<replicate count="3"/>', "<replicate> in a body is not read"),
        ("<freejoint/>", "<frame><joint/></frame>", "['joint'] in a <frame>"),
        ("</actuator>", '</actuator><equality><tendon tendon1="x"/></equality>', "<tendon> 'tendon_1' is not read"),
        ("</actuator>", '</actuator><equality><connect body1="z" anchor="0 0 0"/></equality>', "body = 'z': must be "),
        ("</actuator>", '</actuator><equality><connect body1="a"/></equality>', "anchor = ''"),
        ("</actuator>", "</actuator><deformable><flex/></deformable>", "<flex> is not read"),
        ('<default class="block">', "<default>", "a <default> in another has no class"),
        ("</mujoco>", "", "must be XML"),
        ("<mujoco", "<!DOCTYPE r [<!ENTITY a 'b'>]><mujoco", "document type"),
        ("mujoco", "robot", "its root is <robot>"),
        ("<worldbody>", "<actuators/><worldbody>", "element = 'actuators': must be one of compiler"),
        ("<worldbody>", "<worldbody>" + "<frame>" * 120 + "</frame>" * 120, "100 levels"),
        ("<worldbody>", '<include file="../other.xml"/><worldbody>', "include '../other.xml'"),
        ("<worldbody>", '<include file="arm.xml"/><worldbody>', "include 'arm.xml'"),
        ("<worldbody>", '<include file="/etc/hostname"/><worldbody>', "include '/etc/hostname'"),
    ],
)
def test_broken_files_are_named(old, new, words, file):
    assert old in MECHANISM
    path = file(MECHANISM.replace(old, new) if old == "mujoco" else MECHANISM.replace(old, new, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(InputError) as error:
            mjcf_robot(path)
    assert words in str(error.value), error.value
    assert "arm.xml" in str(error.value)


@pytest.mark.thorough
def test_spoilt_files(file):
    """Each of 150 makes a system, or an InputError."""
    refused = 0
    text = MECHANISM.replace("><", ">\n<")
    for seed in range(150):
        draw = random.Random(seed)
        spoilt = text
        for _ in range(draw.randint(1, 3)):
            place = draw.randrange(len(spoilt))
            lines = spoilt.split("\n")
            k = draw.randrange(len(lines))
            kind = draw.randrange(4)
            if kind == 0:
                spoilt = spoilt[:place] + draw.choice("0123456789.-<>/'\" aejlm=") + spoilt[place + 1 :]
            elif kind == 1:
                spoilt = "\n".join(lines[:k] + lines[k + 1 :])
            elif kind == 2:
                spoilt = "\n".join([*lines[:k], draw.choice(lines), *lines[k:]])
            else:
                new = draw.choice(["0", "1e400", "-1", "j1", '"', "", "body", "1e300"])
                spoilt = spoilt[:place] + new + spoilt[place + draw.randrange(4) :]
        path = file(spoilt)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                mbd.io.read_mjcf(path)
            except InputError:
                refused += 1
    assert 20 < refused < 150


def test_files_are_included_once_and_from_their_folder(file):
    """As if their elements stood there; a chain that comes back ends."""
    file(
        '<mujocoinclude><body name="a"><joint/><geom size=".1"/><include file="b.xml"/></body></mujocoinclude>', "a.xml"
    )
    file('<mujoco><body name="b" pos="1 0 0"><joint/><geom size=".1"/></body></mujoco>', "b.xml")
    main = file(HEAD + '<include file="a.xml"/>' + TAIL)
    with warned("contact"):
        robot = mjcf_robot(main)
    assert [(joint.parent, joint.child) for joint in robot.joints] == [("world", "a"), ("a", "b")]
    file('<mujoco><include file="a.xml"/></mujoco>', "b.xml")
    with refused("arm.xml.include", ANY, "'a.xml'"):
        mjcf_robot(main)


@pytest.mark.parametrize(
    ("shape", "mass", "inertia"),
    [
        ('type="sphere" size=".2"', 4.0 / 3.0 * np.pi * 8.0, (0.4 * 0.04,) * 3),
        ('type="box" size=".1 .2 .3"', 48.0, (0.13 / 3.0, 0.1 / 3.0, 0.05 / 3.0)),
        ('type="ellipsoid" size=".1 .2 .3"', 8.0 * np.pi, (0.026, 0.02, 0.01)),
        ('type="cylinder" size=".1 .3"', 6.0 * np.pi, (0.0325, 0.0325, 0.005)),
        ('type="capsule" fromto="0 0 -.3 0 0 .3" size=".1" mass="22"', 22.0, (0.0495, 0.0495, 0.0536 / 11.0)),
    ],
)
def test_inertia_of_shapes(shape, mass, inertia, file):
    """Closed forms, over the mass; the capsule: rod of 9 parts, ends of 2 parts of the mass."""
    if "capsule" in shape:  # 9 (r2/4 + h2/3) + 2 (2 r2/5 + h2 + 3 h r/4), 9 r2/2 + 2 (2 r2/5), over 11
        inertia = ((9 * 0.0325 + 2 * (0.004 + 0.09 + 0.0225)) / 11.0,) * 2 + ((9 * 0.005 + 2 * 0.004) / 11.0,)
    with warned("contact"):
        link = mjcf_robot(file(HEAD + f'<body name="a"><joint/><geom {shape}/></body>' + TAIL)).links["a"]
    assert link.mass == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(link.inertia, mass * np.diag(inertia), rtol=1e-12, atol=1e-12)


def test_groups_and_total_mass(file):
    """Geoms of other groups have no mass; the total is that of the compiler; <inertial> counts unless geoms do."""
    inertial = '<inertial mass="7" pos="0 0 0" diaginertia="1 1 1"/>'
    bodies = f'<body name="a">{inertial}<joint/><geom size=".1" group="4"/><geom size=".1"/></body>'
    text = f"<mujoco><compiler COMPILER/><worldbody>{bodies}{TAIL}"
    for compiler, mass in (
        ("", 7.0),
        ('settotalmass="3"', 3.0),
        ('inertiafromgeom="true"', 8.0 / 3.0 * np.pi),
        ('inertiafromgeom="true" inertiagrouprange="0 2"', 4.0 / 3.0 * np.pi),
    ):
        with warned("contact"):
            result = mjcf_robot(file(text.replace("COMPILER", compiler))).links["a"].mass
        assert result == pytest.approx(mass)


def test_one_warning_lists_what_is_left_out(file):
    text = """<mujoco><option density="1.2"/><worldbody><body name="a" gravcomp="1"><geom size=".1"/>
    <joint name="h" armature=".1" springdamper="1 1" actuatorfrcrange="-1 1" dampng="1" springyield="1"/>
    <body name="b"><joint name="s" type="ball" damping="1"/><geom size=".1"/></body></body></worldbody>
    <tendon><fixed name="rope"><joint joint="h" coef="1"/></fixed></tendon>
    <actuator><motor name="m" tendon="rope" delay=".1" damping="2" armature=".3"/>
    <muscle name="n" joint="h"/></actuator></mujoco>"""
    with warnings.catch_warnings(record=True) as result:
        warnings.simplefilter("always")
        assert mjcf_robot(file(text)).actuators == ()
    [only] = [str(warning.message) for warning in result]
    for word in (
        "gravcomp",
        "armature",
        "springdamper",
        "actuatorfrcrange",
        "fluid",
        "contact",
        "ball",
        "rope",
        "'m', 'n'",
        "dampng of <joint> ['h']",
        "springyield",
        "delay of <motor>",
        "damping of <motor>",
        "armature of <motor>",
    ):
        assert word in only, word


def test_every_body_of_the_world_and_mass_in_frames_are_read(file):
    geoms = '<frame pos="1 0 0"><geom size=".1" mass="2"/></frame>'
    body = '<body name="{}"><joint name="{}" type="slide"/>' + geoms + "</body>"
    text = (
        "<mujoco><option><flag contact='disable'/></option><worldbody>" + body.format("a", "x") + body.format("b", "y")
    )
    robot = mjcf_robot(file(text + TAIL))
    assert {name: (link.mass, link.center.tolist()) for name, link in robot.links.items() if name != "world"} == {
        "a": (2.0, [1.0, 0.0, 0.0]),
        "b": (2.0, [1.0, 0.0, 0.0]),
    }
