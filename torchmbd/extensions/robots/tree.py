"""Robots as read from files: trees of links and joints; and functions that both readers use.

    urdf.py    Unified Robot Description Format
    mjcf.py    MuJoCo's format

Refused by file and element: files that are too large, document types (entities), texts that are not numbers, missing or
repeated links, loops. Checked in tests/extensions/robots/test_urdf.py, test_mjcf.py.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.errors import InputError, unknown, wrong_entry

LARGEST = 20_000_000  # bytes
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Pose:
    """Position [3] and axes (columns) [3, 3] of one frame in another."""

    position: np.ndarray
    axes: np.ndarray

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.position + self.axes @ other.position, self.axes @ other.axes)

    @property
    def inverse(self) -> Pose:
        return Pose(-self.axes.T @ self.position, self.axes.T)


IDENTITY = Pose(np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class Link:
    """A link: mass [kg], center [m] and inertia about it [kg m2], in the frame of the link."""

    name: str
    mass: float
    center: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Mimic:
    """The relation x = ratio y + offset of the coordinate x of a joint to y, that of another joint; joint "": x = offset."""

    joint: str
    ratio: float
    offset: float


@dataclass(frozen=True)
class RobotJoint:
    """A joint; its frame is that of the child link where its coordinate is zero.

    kind      "revolute", "continuous", "prismatic", "fixed", "planar", "spherical", "floating"
    anchor    a point of its axis in that frame [m]
    limits    [rad, m], None where there are none
    rest      coordinate where its spring has no force
    spring_terms, damper_terms  factors of x^2, x^3 and of v |v|, v^3 in their forces
    start     initial coordinate where none is given
    mimics    how its coordinate follows that of another joint; None: it does not
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
    mimics: Mimic | None = None
    anchor: np.ndarray = field(default_factory=lambda: np.zeros(3))
    stiffness: float = 0.0
    rest: float = 0.0
    start: float = 0.0
    spring_terms: tuple[float, ...] = ()
    damper_terms: tuple[float, ...] = ()

    def displaced(self, q: float) -> Pose:
        """Return the pose of the child link for the coordinate q, relative to its pose for q = 0."""
        if self.kind == "fixed":
            return IDENTITY
        if self.kind == "prismatic":
            return Pose(self.axis * q, np.eye(3))
        turned = rotation(self.axis, q)
        return Pose(self.anchor - turned @ self.anchor, turned)


@dataclass(frozen=True)
class Actuator:
    """A force on the coordinate s of a joint: gear x clamp(gain u + bias[0] + bias[1] gear s + bias[2] gear s'), u its control.

    limits   of the control; None: there are none
    forces   least and largest value of the bracket; None likewise
    """

    name: str
    joint: str
    gear: float
    gain: float
    bias: tuple[float, float, float]
    limits: tuple[float, float] | None = None
    forces: tuple[float, float] | None = None


@dataclass(frozen=True)
class Closure:
    """A joint, "spherical" or "fixed", of two links beside the tree, at a position [3] in the frame of the first; the links fit
    together where all coordinates are at their starts."""

    name: str
    kind: str
    links: tuple[str, str]
    position: np.ndarray


@dataclass(frozen=True)
class Robot:
    """Links by name, joints from the root outwards, and the root link; gravity [3] [m/s2] where the file states it."""

    name: str
    links: dict[str, Link]
    joints: list[RobotJoint]
    root: str
    actuators: tuple[Actuator, ...] = ()
    closures: tuple[Closure, ...] = ()
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the matrix of a rotation by an angle [rad] about a unit vector."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K


def combined_mass(parts: Iterable[tuple[float, np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, center and inertia about it of several masses with centers and inertias about these, in one frame."""
    parts = list(parts)
    mass = sum(m for m, _, _ in parts)
    if not mass > 0.0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    center = np.sum([m * c for m, c, _ in parts], axis=0) / mass
    J = np.zeros((3, 3))
    for m, c, inertia in parts:
        d = c - center
        J += inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
    return mass, center, 0.5 * (J + J.T)


def read_xml(path: str | Path, what: str) -> tuple[Path, ET.Element]:
    """Return a file and its root element; `what`: the name of the format with its article."""
    if not isinstance(path, (str, Path)) or not (file := Path(path)).is_file():
        raise InputError("path", str(path), f"{what} file that exists")
    if file.stat().st_size > LARGEST:
        raise InputError(file.name, allowed=f"must have at most {LARGEST}", state=f"has {file.stat().st_size} bytes")
    text = file.read_bytes()
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text or b"\x00" in text:
        raise InputError(
            file.name, allowed=f"plain {what.partition(' ')[2]}", state="has a document type or is not UTF-8 text"
        )
    try:
        return file, ET.fromstring(text)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise wrong_entry(file.name, f"{error}", "XML") from None


def robot_tree(file: str, name: str, links: dict[str, Link], joints: list[RobotJoint], hint: str = "") -> Robot:
    """Return a robot whose joints are sorted from the root outwards; InputError unless links form a tree."""
    parents: dict[str, str] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise unknown(f"{file}, joint {joint.name!r}: link", link, links, (file, "joint", joint.name, "link"))
        if joint.child in parents:
            raise wrong_entry(file, f"link {joint.child!r} is the child of two joints", "must form a tree")
        parents[joint.child] = joint.parent
    roots = [link for link in links if link not in parents]
    if not links:
        raise wrong_entry(file, "no <link>", f"a robot of links{hint}", key="link")
    if len(roots) != 1:
        raise wrong_entry(
            file, f"links {roots} have no parent", "must have one root, with all others joined to it", key="link"
        )
    ordered, reached = [], [roots[0]]
    by_parent: dict[str, list[RobotJoint]] = {}
    for joint in joints:
        by_parent.setdefault(joint.parent, []).append(joint)
    for link in reached:  # grows
        for joint in by_parent.get(link, []):
            ordered.append(joint)
            reached.append(joint.child)
    if len(reached) < len(links):
        raise wrong_entry(
            file, f"links {sorted(links.keys() - set(reached))[:8]} form a loop", "must form a tree", key="link"
        )
    return Robot(name, links, ordered, roots[0])


def by_unique_name(file: str, kind: str, items: Iterable[Any]) -> dict[str, Any]:
    """Return links or joints by name; InputError if a name is repeated."""
    entries: dict[str, Any] = {}
    for x in items:
        if x.name in entries:
            raise InputError(
                (file, kind, x.name),
                allowed="must appear once",
                noun=f"{file}: {kind} {x.name!r}",
                state="appears twice",
            )
        entries[x.name] = x
    return entries


def numbers(where: str, key: str, text: str, count: int | None = None) -> list[float]:
    """Read the numbers of the attribute `key`, `count` of them."""
    words = text.split()
    values = [float(word) for word in words if _NUMBER.fullmatch(word)]
    size = max(len(words), 1) if count is None else count
    if len(words) != size or len(values) != size or not all(map(math.isfinite, values)):
        many = "numbers" if count is None else f"{count} number{'s' if count > 1 else ''}"
        raise InputError((where, key), text, many, noun=f"{where}: {key}")
    return values
