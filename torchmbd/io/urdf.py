"""Robots in the Unified Robot Description Format: links with inertia, joints with origin, axis, limits, damping, friction.

Not read: visual and collision geometry, limits of effort and velocity, transmissions, plugins. A <limit> without lower and
upper is none. Refused by file and element: a link or joint that comes twice or lacks, loops, numbers that are none, a document
type (entities).
Source: wiki.ros.org/urdf/XML. Checked in tests/io/test_urdf.py.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchmbd.errors import InputError, unknown, warn

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
LARGEST = 20_000_000  # bytes
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Pose:
    """Place [3] and axes (columns) [3, 3] of one frame in another."""

    place: np.ndarray
    axes: np.ndarray

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.place + self.axes @ other.place, self.axes @ other.axes)


@dataclass(frozen=True)
class UrdfLink:
    """A link: mass [kg], center [m] and inertia about it [kg m2], in the frame of the link."""

    name: str
    mass: float
    center: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class UrdfJoint:
    """A joint; its frame is that of the child link where its coordinate is zero.

    limits   [rad, m], None where there are none
    mimics   whether its coordinate follows that of another joint
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Pose
    axis: np.ndarray
    limits: tuple[float, float] | None
    damping: float
    friction: float
    mimics: bool = False


@dataclass(frozen=True)
class Robot:
    """Links by name, joints from the root outwards, and the root link."""

    name: str
    links: dict[str, UrdfLink]
    joints: list[UrdfJoint]
    root: str


def read_urdf(path: str | Path) -> Robot:
    """Read a robot. InputError names file, element and value."""
    if not isinstance(path, (str, Path)) or not (file := Path(path)).is_file():
        raise InputError(f"path is {str(path)!r}; allowed: a URDF file that exists")
    if file.stat().st_size > LARGEST:
        raise InputError(f"{file.name} has {file.stat().st_size} bytes; allowed: {LARGEST}")
    text = file.read_bytes()
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text or b"\x00" in text:
        raise InputError(f"{file.name} has a document type or is no UTF-8 text; allowed: plain URDF")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{file.name}: {error}; allowed: XML") from None
    if root.tag != "robot":
        raise InputError(f"{file.name}: its root is <{root.tag}>; allowed: <robot> (expand a xacro file first)")
    for element in root.iter():
        if "xacro" in element.tag:
            raise InputError(f"{file.name} has <{element.tag}>; allowed: plain URDF (expand a xacro file first)")
    links: dict[str, UrdfLink] = {}
    for element in root.findall("link"):
        link = _link(file.name, element)
        if link.name in links:
            raise InputError(f"{file.name}: link {link.name!r} stands twice")
        links[link.name] = link
    joints: dict[str, UrdfJoint] = {}
    for element in root.findall("joint"):
        joint = _joint(file.name, element)
        if joint.name in joints:
            raise InputError(f"{file.name}: joint {joint.name!r} stands twice")
        joints[joint.name] = joint
    return _tree(file.name, root.get("name") or "robot", links, list(joints.values()))


def _tree(file: str, name: str, links: dict[str, UrdfLink], joints: list[UrdfJoint]) -> Robot:
    """Joints from the root outwards; each link but the root has one parent."""
    parents: dict[str, str] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise unknown(f"{file}, joint {joint.name!r}: link", link, links)
        if joint.child in parents:
            raise InputError(f"{file}: link {joint.child!r} is the child of two joints; allowed: a tree")
        parents[joint.child] = joint.parent
    roots = [link for link in links if link not in parents]
    if not links:
        raise InputError(f"{file}: no <link>; allowed: a robot of links (expand a xacro file first)")
    if len(roots) != 1:
        raise InputError(f"{file}: links {roots} have no parent; allowed: one root, all others joined to it")
    ordered, reached = [], [roots[0]]
    by_parent: dict[str, list[UrdfJoint]] = {}
    for joint in joints:
        by_parent.setdefault(joint.parent, []).append(joint)
    for link in reached:  # grows
        for joint in by_parent.get(link, []):
            ordered.append(joint)
            reached.append(joint.child)
    if len(reached) < len(links):
        raise InputError(f"{file}: links {sorted(links.keys() - set(reached))[:8]} form a loop; allowed: a tree")
    return Robot(name, links, ordered, roots[0])


def _named(file: str, element: ET.Element) -> str:
    name = element.get("name")
    if not name:
        raise InputError(f"{file}: a <{element.tag}> has no name")
    if "${" in name or "$(" in name:
        raise InputError(f"{file}: <{element.tag}> {name!r}; allowed: plain names (expand a xacro file first)")
    return name


def _numbers(where: str, text: str, count: int) -> list[float]:
    words = text.split()
    values = [float(word) for word in words if _NUMBER.fullmatch(word)]
    if len(words) != count or len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{where} is {text!r}; allowed: {count} number{'s' if count > 1 else ''}")
    return values


def _one(where: str, element: ET.Element | None, key: str, default: float | None = None) -> float:
    text = None if element is None else element.get(key)
    if text is None:
        if default is None:
            raise InputError(f"{where}: {key} is missing; allowed: a number")
        return default
    return _numbers(f"{where}: {key}", text, 1)[0]


def _pose(where: str, element: ET.Element | None) -> Pose:
    place, angles = (
        _numbers(f"{where}: {key}", "0 0 0" if element is None else element.get(key, "0 0 0"), 3)
        for key in ("xyz", "rpy")
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


def _link(file: str, element: ET.Element) -> UrdfLink:
    name = _named(file, element)
    where, inertial = f"{file}, link {name!r}", element.find("inertial")
    if inertial is None:
        return UrdfLink(name, 0.0, np.zeros(3), np.zeros((3, 3)))
    pose = _pose(where, inertial.find("origin"))
    mass = _one(where, inertial.find("mass"), "value")
    own = inertial.find("inertia")
    xx, xy, xz, yy, yz, zz = (_one(where, own, key, 0.0) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass < 0.0:
        raise InputError(f"{where}: mass is {mass:g}; allowed: zero or positive")
    if own is None and mass:
        warn(f"{where}: it has no <inertia>; taken as a point of {mass:g} kg")
    return UrdfLink(name, mass, pose.place, pose.axes @ J @ pose.axes.T)


def _joint(file: str, element: ET.Element) -> UrdfJoint:
    name = _named(file, element)
    where, kind = f"{file}, joint {name!r}", element.get("type", "")
    if kind not in KINDS:
        raise unknown(f"{where}: type", kind, KINDS)
    ends = []
    for end in ("parent", "child"):
        own = element.find(end)
        if own is None or not own.get("link"):
            raise InputError(f"{where}: {end} is missing; allowed: <{end} link=...>")
        ends.append(own.get("link", ""))
    given = element.find("axis")
    axis = np.array(_numbers(f"{where}: axis", "1 0 0" if given is None else given.get("xyz", "1 0 0"), 3))
    length = float(np.linalg.norm(axis))
    if kind != "fixed" and not length > 1e-9:
        raise InputError(f"{where}: axis is {axis.tolist()}; allowed: a direction")
    limit, dynamics, limits = element.find("limit"), element.find("dynamics"), None
    if kind in ("revolute", "prismatic") and limit is not None and {"lower", "upper"} & set(limit.keys()):
        limits = _one(where, limit, "lower", 0.0), _one(where, limit, "upper", 0.0)
        if limits[0] > limits[1]:
            raise InputError(f"{where}: lower is {limits[0]:g}, upper {limits[1]:g}; allowed: lower below upper")
    losses = [_one(where, dynamics, key, 0.0) for key in ("damping", "friction")]
    if min(losses) < 0.0:
        raise InputError(f"{where}: damping, friction are {losses}; allowed: zero or positive")
    origin = _pose(where, element.find("origin"))
    mimics, axis = kind != "fixed" and element.find("mimic") is not None, axis / (length or 1.0)
    return UrdfJoint(name, kind, ends[0], ends[1], origin, axis, limits, losses[0], losses[1], mimics)
