"""Robots in the Unified Robot Description Format: links with inertia, joints with origin, axis, limits, damping, friction.

Not read: visual and collision geometry, limits of effort and velocity, transmissions, plugins; unknown elements are told. A
<limit> without lower and upper does not limit, nor does one with lower above upper (Bullet's convention), which is told.
Refused by file and element: missing or repeated elements, loops, texts that are not numbers, a document type (entities).
Source: wiki.ros.org/urdf/XML. Checked in tests/extensions/robots/test_urdf.py.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from torchmbd.errors import InputError, unknown, warn, wrong_entry
from torchmbd.extensions.robots.tree import (
    Link,
    Mimic,
    Pose,
    Robot,
    RobotJoint,
    by_unique_name,
    numbers,
    read_xml,
    robot_tree,
)

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


#: Elements that are read, and those that do not change the motion; others are told, because mass may stand in them.
_PARTS = {
    "robot": "link joint material transmission gazebo sensor group_state mujoco drake",
    "link": "inertial visual collision contact gazebo sensor self_collision_checking verbose",
    "inertial": "origin mass inertia",
    "joint": "origin parent child axis limit dynamics mimic calibration safety_controller hardware gazebo",
}
_ONCE = ("inertial", "mass", "inertia", "parent", "child", "axis", "limit", "dynamics", "mimic", "origin")


def urdf_robot(path: str | Path) -> Robot:
    """Read a robot. InputError names file, element and value."""
    file, root = read_xml(path, "a URDF")
    if root.tag != "robot":
        raise wrong_entry(file.name, f"its root is <{root.tag}>", "<robot> (expand a xacro file first)")
    for element in root.iter():
        if "xacro" in element.tag:
            raise InputError(
                file.name,
                allowed="plain URDF",
                state=f"has <{element.tag}>",
                hint="xacro, which expands the file first",
            )
    _check_parts(file.name, root)
    links = by_unique_name(file.name, "link", (_link(file.name, element) for element in root.findall("link")))
    joints = by_unique_name(file.name, "joint", (_joint(file.name, element) for element in root.findall("joint")))
    return robot_tree(
        file.name, root.get("name") or "robot", links, list(joints.values()), " (expand a xacro file first)"
    )


def _check_parts(file: str, root: ET.Element) -> None:
    """InputError for an element that appears twice; a warning for those that are not known."""
    unknown_parts: dict[str, list[str]] = {}
    within = [*root.findall("link"), *root.findall("joint")]
    for element in (root, *within, *root.findall("link/inertial")):
        tags = [child.tag for child in element]
        twice = [tag for tag in _ONCE if tags.count(tag) > 1]
        if twice:
            raise InputError(
                (file, element.tag, twice[0]),
                allowed="must appear once",
                state="appears twice",
                noun=f"{file}, <{element.tag}> {element.get('name', '')!r}: <{twice[0]}>",
            )
        for tag in set(tags) - set(_PARTS[element.tag].split()):
            if isinstance(tag, str):
                unknown_parts.setdefault(f"<{tag}> in <{element.tag}>", []).append(element.get("name", ""))
    if unknown_parts:
        listed = "; ".join(f"{kind} {sorted(set(names))[:8]}" for kind, names in sorted(unknown_parts.items()))
        warn(f"{file}: the reader leaves out these unknown elements: {listed}")


def _named(file: str, element: ET.Element) -> str:
    name = element.get("name")
    if not name:
        raise InputError(
            (file, element.tag, "name"),
            allowed="must have a name",
            noun=f"{file}: a <{element.tag}>",
            state="has no name",
        )
    if "${" in name or "$(" in name:
        raise InputError(
            (file, element.tag, "name"),
            name,
            "a plain name",
            noun=f"{file}: name of <{element.tag}>",
            hint="xacro, which expands the file first",
        )
    return name


def _number(where: str, element: ET.Element | None, key: str, default: float | None = None) -> float:
    text = None if element is None else element.get(key)
    if text is None:
        if default is None:
            raise InputError((str(where), key), allowed="a number", noun=f"{where}: {key}", state="is missing")
        return default
    return numbers(where, key, text, 1)[0]


def _pose(where: str, element: ET.Element | None) -> Pose:
    place, angles = (
        numbers(where, key, "0 0 0" if element is None else element.get(key, "0 0 0"), 3) for key in ("xyz", "rpy")
    )
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    axes = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return Pose(np.array(place), axes)


def _link(file: str, element: ET.Element) -> Link:
    name = _named(file, element)
    where, inertial = f"{file}, link {name!r}", element.find("inertial")
    if inertial is None:
        return Link(name, 0.0, np.zeros(3), np.zeros((3, 3)))
    pose = _pose(where, inertial.find("origin"))
    mass = _number(where, inertial.find("mass"), "value")
    tensor = inertial.find("inertia")
    xx, xy, xz, yy, yz, zz = (_number(where, tensor, key, 0.0) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass < 0.0:
        raise InputError((str(where), "mass"), mass, "zero or positive", noun=f"{where}: mass", shown=f"{mass:g}")
    if tensor is None and mass:
        warn(f"{where}: it has no <inertia>; the reader makes it a point mass of {mass:g} kg")
    return Link(name, mass, pose.position, pose.axes @ J @ pose.axes.T)


def _joint(file: str, element: ET.Element) -> RobotJoint:
    name = _named(file, element)
    where, kind = f"{file}, joint {name!r}", element.get("type", "")
    if kind not in KINDS:
        raise unknown(f"{where}: type", kind, KINDS, (where, "type"))
    ends = []
    for end in ("parent", "child"):
        link = element.find(end)
        if link is None or not link.get("link"):
            raise InputError(
                (str(where), str(end)), allowed=f"<{end} link=...>", noun=f"{where}: {end}", state="is missing"
            )
        ends.append(link.get("link", ""))
    axis_element = element.find("axis")
    axis = np.array(numbers(where, "axis", "1 0 0" if axis_element is None else axis_element.get("xyz", "1 0 0"), 3))
    length = float(np.linalg.norm(axis))
    if kind != "fixed" and not length > 1e-9:
        raise InputError(
            (str(where), "axis"), axis.tolist(), "a direction", noun=f"{where}: axis", shown=f"{axis.tolist()}"
        )
    limit, dynamics, limits = element.find("limit"), element.find("dynamics"), None
    if kind in ("revolute", "prismatic") and limit is not None and {"lower", "upper"} & set(limit.keys()):
        limits = _number(where, limit, "lower", 0.0), _number(where, limit, "upper", 0.0)
        if limits[0] > limits[1]:  # the convention of Bullet
            warn(f"{where}: lower is {limits[0]:g}, upper {limits[1]:g}; the reader leaves out both limits")
            limits = None
    losses = [_number(where, dynamics, key, 0.0) for key in ("damping", "friction")]
    if min(losses) < 0.0:
        raise wrong_entry(where, f"damping, friction are {losses}", "zero or positive", key="damping")
    origin = _pose(where, element.find("origin"))
    mimics = None if kind == "fixed" else _mimic(where, element.find("mimic"))
    return RobotJoint(
        name, kind, ends[0], ends[1], origin, axis / (length or 1.0), limits, losses[0], losses[1], mimics
    )


def _mimic(where: str, element: ET.Element | None) -> Mimic | None:
    if element is None:
        return None
    if not element.get("joint"):
        raise wrong_entry(
            where, "joint of <mimic> is missing", key="mimic", hint="<mimic joint=... multiplier=... offset=...>"
        )
    ratio, offset = (_number(where, element, key, x) for key, x in (("multiplier", 1.0), ("offset", 0.0)))
    return Mimic(element.get("joint", ""), ratio, offset)
