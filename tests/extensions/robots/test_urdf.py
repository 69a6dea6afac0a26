"""URDF files that are broken: named by file and element; 200 spoilt files; no entities."""

from __future__ import annotations

import random
import warnings

import pytest

import torchmbd as mbd
from tests.extensions.robots.test_robot import ARM
from tests.refused import refused, warned
from torchmbd.errors import InputError
from torchmbd.extensions.robots.urdf import urdf_robot

TEXT = '<robot name="arm">\n' + "\n".join(ARM) + "\n</robot>\n"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('type="continuous"', 'type="ball"', "joint 'j3': type = 'ball'"),
        ('<parent link="link2"/>', '<parent link="link7"/>', "link = 'link7'"),
        ('<parent link="link2"/>', "", "joint 'j3': parent is missing"),
        ('<child link="link3"/>', '<child link="link2"/>', "child of two joints"),
        ('xyz="0.6 0 0.8"', 'xyz="0 0 0"', "joint 'j3': axis = "),
        ('xyz="0.6 0 0.8"', 'xyz="0.6 0"', "must be 3 numbers"),
        ('<mass value="0.4"/>', '<mass value="-0.4"/>', "link 'link3': mass = -0.4"),
        ('<mass value="0.4"/>', '<mass value="nan"/>', "value = 'nan'"),
        ('<mass value="0.4"/>', "", "value is missing"),
        ('name="link3"', 'name="link2"', "appears twice"),
        ('<mass value="0.4"/>', '<mass value="0.4"/><mass value="0.5"/>', "<mass> appears twice"),
        ("<inertial>", "<inertial/><inertial>", "<inertial> appears twice"),
        ('damping="0.3"', 'damping="-0.3"', "damping, friction"),
        ('<parent link="world"/>', '<parent link="link3"/>', "form a loop"),
        ("</robot>", '<link name="alone"/></robot>', "have no parent"),
        ("</robot>", "", "must be XML"),
        ("<robot", "<!DOCTYPE r [<!ENTITY a 'b'>]><robot", "document type"),
        ("robot", "model", "its root is <model>"),
        (
            "</robot>",
            '<x:arm xmlns:x="http://www.ros.org/wiki/xacro"/></robot>',
            "Try: xacro, which expands the file first",
        ),
        ('name="j3"', 'name="${side}_j3"', "'${side}_j3'"),
    ],
)
def test_broken_files_are_named(old, new, words, tmp_path):
    assert old in TEXT
    path = tmp_path / "arm.urdf"
    path.write_text(TEXT.replace(old, new, 2 if old == "robot" else 1) if old != "robot" else TEXT.replace(old, new))
    with pytest.raises(InputError) as error:
        urdf_robot(path)
    assert words in str(error.value), error.value
    assert "arm.urdf" in str(error.value)


def test_a_mass_without_inertia_is_said(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text('<robot name="a"><link name="b"><inertial><mass value="2"/></inertial></link></robot>')
    with warned("arm.urdf, link 'b'", "<inertia>", "2 kg"):
        assert not urdf_robot(path).links["b"].inertia.any()


def test_lower_above_upper_is_no_limit(tmp_path):
    """Bullet's convention, with a warning; the system has no stop there."""
    path = tmp_path / "arm.urdf"
    path.write_text(TEXT.replace('lower="-2" upper="2"', 'lower="2" upper="-2"'))
    with warned("arm.urdf, joint 'j", "lower is 2, upper -2"):
        limits = [joint.limits for joint in urdf_robot(path).joints]
    path.write_text(TEXT)
    expected = [None if joint.limits == (-2.0, 2.0) else joint.limits for joint in urdf_robot(path).joints]
    assert limits == expected


def test_elements_that_are_not_known_are_told(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(TEXT.replace("<inertial>", "<inertail/><inertial>", 1))
    with warned("arm.urdf", "<inertail> in <link> ['"):
        urdf_robot(path)


def test_joints_of_one_name(tmp_path):
    """'j 2' and 'j_2' would both be 'j_2' in the system."""
    path = tmp_path / "arm.urdf"
    path.write_text(TEXT.replace('name="j2"', 'name="j 3"').replace('name="j3"', 'name="j_3"'))
    with refused("joints.j_3"):
        mbd.io.read_urdf(path, stop_stiffness=None)


@pytest.mark.thorough
def test_spoilt_files(tmp_path):
    """Each of 200 makes a system, or an InputError."""
    path, refused = tmp_path / "arm.urdf", 0
    for seed in range(200):
        draw = random.Random(seed)
        text = TEXT
        for _ in range(draw.randint(1, 3)):
            place = draw.randrange(len(text))
            lines = text.split("\n")
            k = draw.randrange(len(lines))
            kind = draw.randrange(4)
            if kind == 0:
                text = text[:place] + draw.choice("0123456789.-<>/'\" aejlm=") + text[place + 1 :]
            elif kind == 1:
                text = "\n".join(lines[:k] + lines[k + 1 :])
            elif kind == 2:
                text = "\n".join([*lines[:k], draw.choice(lines), *lines[k:]])
            else:
                text = (
                    text[:place] + draw.choice(["0", "1e400", "-1", "link1", '"']) + text[place + draw.randrange(4) :]
                )
        path.write_text(text)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                mbd.io.read_urdf(path)
            except InputError:
                refused += 1
    assert 20 < refused < 200
