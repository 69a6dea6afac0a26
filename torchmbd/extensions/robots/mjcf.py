"""Mechanisms in MuJoCo's format (MJCF): bodies, joints, springs, actuators on joints, connections.

    body, frame, include     links; a body that has several joints follows links of TINY of its mass
    hinge, slide             revolute, prismatic: limits, damping and stiffness (also polynomials), friction, springref, ref
    ball, free               spherical, floating
    inertial, or geom        sphere, capsule, cylinder, box, ellipsoid, by mass or density
    motor, position, velocity, general on joints (gain fixed, bias none or affine)
    connect, weld, joint     spherical, fixed, a joint that mimics another by a linear relation

Defaults, classes, units of angles and inertia of geoms are as in MuJoCo; also the flags that disable contact, limits,
friction, equality or gravity. Not read: elements that are seen or measured (assets, visuals, sites, sensors, cameras,
keyframes) and options of the solver. One warning lists elements that would change the motion and are left out, such as
armature, tendons and contact, and unknown attributes, such as misspelt ones. All others are refused by file, element and
value, such as deformable or repeated bodies.
Source: mujoco.readthedocs.io, XML reference. Checked in tests/extensions/robots/test_mjcf.py, test_robot_mjcf.py.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.errors import InputError, unknown, warn, wrong_entry
from torchmbd.extensions.robots.mjcf_values import ACTUATORS, SHAPES, Attributes, Values, axes_along_z, shape_inertia
from torchmbd.extensions.robots.tree import (
    IDENTITY,
    LARGEST,
    Actuator,
    Closure,
    Link,
    Mimic,
    Pose,
    Robot,
    RobotJoint,
    by_unique_name,
    combined_mass,
    read_xml,
    robot_tree,
)

DEEPEST = 100  # levels of elements
TINY = 1e-12  # mass and inertia of the links between several joints of a body, as a share of those of the body
THIN = ("plane", "hfield")  # shapes without mass
BODY = ("body", "frame", "geom", "inertial", "joint", "freejoint", "site", "camera", "light")
KINDS = {"hinge": "revolute", "slide": "prismatic", "ball": "spherical", "free": "floating"}


def mjcf_robot(path: str | Path) -> Robot:
    """Read a file; the ground is the link "world". InputError names file, element and value."""
    file, root = read_xml(path, "an MJCF")
    if root.tag != "mujoco":
        raise wrong_entry(file.name, f"its root is <{root.tag}>", "<mujoco>")
    _include(file, root)
    return _Reader(file.name, root).robot()


def _include(file: Path, root: ET.Element) -> None:
    """Replace each <include> by the elements of its file; a file may be included once."""
    folder, seen, size = file.parent.resolve(), {file.resolve()}, file.stat().st_size
    level, depth = [root], 0
    while level:
        for parent in level:
            k = 0
            while k < len(parent):  # grows
                if parent[k].tag != "include":
                    k += 1
                    continue
                name = parent[k].get("file", "")
                other = (folder / name).resolve()
                if not other.is_relative_to(folder) or not other.is_file() or other in seen:
                    raise wrong_entry(file.name, f"include {name!r}", "a file of its folder, once", key="include")
                seen.add(other)
                size += other.stat().st_size
                if size > LARGEST:
                    raise InputError(
                        file.name,
                        allowed="must have fewer",
                        state=f"has more than {LARGEST} bytes with what it includes",
                    )
                parent[k : k + 1] = list(read_xml(other, "an MJCF")[1])
        level, depth = [child for parent in level for child in parent], depth + 1
        if depth > DEEPEST:
            raise InputError(file.name, allowed="must have fewer", state=f"has more than {DEEPEST} levels of elements")


class _Reader(Values):
    """Links and joints of one file."""

    def robot(self) -> Robot:
        self.links: list[Link] = [Link("world", 0.0, np.zeros(3), np.zeros((3, 3)))]
        self.joints: list[RobotJoint] = []
        if self.root.find("deformable/flex") is not None:
            raise wrong_entry(self.file, "<flex> is not read", "must have rigid bodies alone", key="flex")
        self.count, self.touching = itertools.count(1), False
        for world in self.root.findall("worldbody"):
            self._children(world, "world", IDENTITY, world.get("childclass", "main"))
        if len(self.links) == 1:
            raise wrong_entry(self.file, "no <body>", "must have bodies in <worldbody>", key="body")
        total, total_mass = (
            sum(link.mass for link in self.links),
            self.number(f"{self.file}, compiler", self.compiler, "settotalmass", "-1"),
        )
        if total_mass > 0.0 and total > 0.0:
            scale = total_mass / total
            self.links = [replace(x, mass=scale * x.mass, inertia=scale * x.inertia) for x in self.links]
        links = by_unique_name(self.file, "body", self.links)
        joints = by_unique_name(self.file, "joint", self.joints)
        gravity = self._option()
        closures = [
            closure for element in self.root.findall("equality") for closure in self._closures(element, joints, links)
        ]
        tree = robot_tree(self.file, self.root.get("model") or "mechanism", links, list(joints.values()))
        actuators = [actuator for part in self.root.findall("actuator") for actuator in self._actuators(part, joints)]
        by_unique_name(self.file, "actuator", actuators)
        for element in (x for part in self.root.findall("tendon") for x in part):
            self.note_omitted("tendons", element.get("name", ""))
        if self.omitted:
            listed = (f"{kind} {sorted(set(names) - {''})[:8]}" for kind, names in self.omitted.items())
            warn(f"{self.file}: left out: {'; '.join(listed)}".replace(" []", ""))
        return replace(tree, actuators=tuple(actuators), closures=tuple(closures), gravity=gravity)

    # The tree

    def _flat(self, parent: ET.Element, pose: Pose, inherited: str) -> Iterator[tuple[ET.Element, Pose, str]]:
        """Return the elements of a body, also those in frames, with the pose of the enclosing frame and their class."""
        for element in parent:
            if element.tag == "frame":
                if held := {x.tag for x in element} & {"joint", "freejoint", "inertial"}:
                    raise wrong_entry(self.file, f"{sorted(held)} in a <frame>", "in a <body>", key="frame")
                frame = pose @ self.pose(f"{self.file}, frame {element.get('name', '')!r}", element.attrib)
                yield from self._flat(element, frame, element.get("childclass", inherited))
            elif element.tag not in BODY:
                raise wrong_entry(self.file, f"<{element.tag}> in a body is not read", f"one of {', '.join(BODY)}")
            else:
                yield element, pose, inherited

    def _children(self, parent: ET.Element, link: str, pose: Pose, inherited: str) -> None:
        for element, around, default in self._flat(parent, pose, inherited):
            if element.tag == "body":
                self._body(element, link, around, element.get("childclass", default))

    def _body(self, element: ET.Element, parent: str, around: Pose, inherited: str) -> None:
        name = element.get("name") or f"body_{next(self.count)}"
        where = f"{self.file}, body {name!r}"
        if self.number(where, element.attrib, "gravcomp"):
            self.note_omitted("gravcomp of", name)
        origin = around @ self.pose(where, element.attrib)
        inside = list(self._flat(element, IDENTITY, inherited))
        mass, center, inertia = self._mass(where, inside)
        joints = [(x, default) for x, _, default in inside if x.tag in ("joint", "freejoint")]
        for k, (joint, default) in enumerate(joints):
            last, unnamed = k + 1 == len(joints), f"{name}_joint{k + 1 if len(joints) > 1 else ''}"
            child = name if last else f"{name}_{joint.get('name', unnamed)}"
            share = 1.0 if last else TINY
            made = self._joint(joint, default, parent, child, origin, unnamed)
            if made.kind == "floating" and (len(joints) > 1 or parent != "world"):
                raise wrong_entry(
                    where, "a free joint among others or below a body", "alone, in <worldbody>", key="freejoint"
                )
            self.joints.append(made)
            self.links.append(Link(child, share * mass, center, share * inertia))
            parent, origin = child, IDENTITY
        if not joints:
            self.joints.append(RobotJoint(f"{name}_fixed", "fixed", parent, name, origin, np.zeros(3), None, 0.0, 0.0))
            self.links.append(Link(name, mass, center, inertia))
        self._children(element, name, IDENTITY, inherited)

    def _joint(self, element: ET.Element, inherited: str, parent: str, child: str, pose: Pose, name: str) -> RobotJoint:
        attributes = (
            self.attributes(element, inherited) if element.tag == "joint" else {"type": "free"} | element.attrib
        )
        name = element.get("name") or name
        where, kind = f"{self.file}, joint {name!r}", attributes.get("type", "hinge")
        if kind not in KINDS:
            raise unknown(f"{where}: type", kind, KINDS, (where, "type"))
        unit = self.angle if kind == "hinge" else 1.0
        dampers, springs = (self.terms(where, attributes, key) for key in ("damping", "stiffness"))
        friction = self.number(where, attributes, "frictionloss")
        losses = [dampers[0], friction, springs[0]]
        if min(losses) < 0.0:
            raise wrong_entry(
                where, f"damping, frictionloss, stiffness are {losses}", "zero or positive", key="damping"
            )
        for key in ("armature", "springdamper", "actuatorfrcrange"):
            if any(self.numbers(where, attributes, key, "0")):
                self.note_omitted(f"{key} of joints", name)
        has_one_coordinate = kind in ("hinge", "slide")  # to the others MuJoCo applies no limit that has no range
        ranged = has_one_coordinate or (kind == "ball" and any(self.numbers(where, attributes, "range", "0 0", 2)))
        limits = self.limits(where, attributes, "range", "limited") if ranged else None
        if self.is_disabled("limit", "constraint"):
            limits = None
        if self.is_disabled("frictionloss", "constraint"):
            friction = 0.0
        axis = self.direction(where, attributes, "axis", "0 0 1")
        start, rest = (unit * self.number(where, attributes, key) for key in ("ref", "springref"))
        if not has_one_coordinate:
            if any((*dampers, friction, *springs, limits)):
                self.note_omitted(f"limits, damping and springs of {kind} joints", name)
            limits, dampers, friction, springs, start = None, (0.0,), 0.0, (0.0,), 0.0
        made = RobotJoint(
            name,
            KINDS[kind],
            parent,
            child,
            pose,
            axis,
            None if limits is None else (unit * limits[0], unit * limits[1]),
            dampers[0],
            friction,
            anchor=np.array(self.numbers(where, attributes, "pos", "0 0 0", 3)) if kind != "free" else np.zeros(3),
            stiffness=springs[0],
            rest=rest,
            start=start,
            spring_terms=springs[1:],
            damper_terms=dampers[1:],
        )
        return replace(made, origin=pose @ made.displaced(-start))

    # Mass

    def _mass(self, where: str, inside: list[tuple[ET.Element, Pose, str]]) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass, center and inertia about it, in the frame of the body."""
        source = self.compiler.get("inertiafromgeom", "auto")
        inertials = [x for x, _, _ in inside if x.tag == "inertial"]
        geoms = [(self.attributes(x, default, "geom"), pose) for x, pose, default in inside if x.tag == "geom"]
        self.touching |= any(self.number(where, x, key, "1") for x, _ in geoms for key in ("contype", "conaffinity"))
        if source == "true" or (source == "auto" and not inertials):
            return combined_mass(part for x, pose in geoms if (part := self._geom(where, x, pose)) is not None)
        if not inertials:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        inertial = inertials[0].attrib
        pose, mass = self.pose(f"{where}, inertial", inertial), self.number(f"{where}, inertial", inertial, "mass", "")
        if mass < 0.0:
            place = f"{where}, inertial"
            raise InputError((place, "mass"), mass, "zero or positive", noun=f"{place}: mass", shown=f"{mass:g}")
        if "fullinertia" in inertial:
            xx, yy, zz, xy, xz, yz = self.numbers(f"{where}, inertial", inertial, "fullinertia", "", 6)
            J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            J = np.diag(self.numbers(f"{where}, inertial", inertial, "diaginertia", "0 0 0", 3))
        return mass, pose.position, pose.axes @ J @ pose.axes.T

    def _geom(self, where: str, attributes: Attributes, around: Pose) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Return mass, center and inertia of a geom; None where it has no mass."""
        where, kind = f"{where}, geom {attributes.get('name', '')!r}", attributes.get("type", "sphere")
        lowest, highest = self.numbers(f"{self.file}, compiler", self.compiler, "inertiagrouprange", "0 5", 2)
        mass, density = self.number(where, attributes, "mass", "-1"), self.number(where, attributes, "density", "1000")
        if kind in THIN or 0.0 in (mass, density if mass < 0.0 else 1.0):
            return None
        if not lowest <= self.number(where, attributes, "group") <= highest:
            return None
        if (shell := attributes.get("shellinertia", "false")) != "false":
            raise InputError(
                (str(where), "shellinertia"), shell, "'false', or <inertial> in the body", noun=f"{where}: shellinertia"
            )
        if kind not in SHAPES or "mesh" in attributes:
            raise wrong_entry(
                where,
                f"type {('mesh' if 'mesh' in attributes else kind)!r} gives no inertia here",
                f"{', '.join(SHAPES)}, or <inertial> in the body",
                key="type",
            )
        size, pose = self.numbers(where, attributes, "size", ""), self.pose(where, attributes)
        if "fromto" in attributes and kind != "sphere":
            ends = np.array(self.numbers(where, attributes, "fromto", "", 6)).reshape(2, 3)
            half = 0.5 * float(np.linalg.norm(ends[1] - ends[0]))
            if not half > 1e-9:
                raise InputError((str(where), "fromto"), attributes["fromto"], "two points", noun=f"{where}: fromto")
            pose = Pose(ends.mean(0), axes_along_z((ends[0] - ends[1]) / (2.0 * half)))
            size = [*size[:1] * (SHAPES[kind] - 1), half]
        if len(size) < SHAPES[kind] or min(size[: SHAPES[kind]]) <= 0.0:
            raise InputError(
                (str(where), "size"),
                size,
                f"{SHAPES[kind]} positive numbers of a {kind}",
                noun=f"{where}: size",
                shown=f"{size}",
            )
        volume, inertia = shape_inertia(kind, size)
        mass = mass if mass >= 0.0 else density * volume
        pose = around @ pose
        return mass, pose.position, mass * pose.axes @ np.diag(inertia) @ pose.axes.T

    # What acts

    def _option(self) -> tuple[float, ...]:
        """Return gravity; note options that are left out."""
        where = f"{self.file}, option"
        if self.number(where, self.option, "density") or self.number(where, self.option, "viscosity"):
            self.note_omitted("forces of the fluid around", "")
        if self.touching and not self.is_disabled("contact", "constraint"):
            self.note_omitted("contact between geoms", "")
        gravity = self.numbers(where, self.option, "gravity", "0 0 -9.81", 3)
        return (0.0, 0.0, 0.0) if self.is_disabled("gravity") else tuple(gravity)

    def _closures(self, part: ET.Element, joints: dict[str, Any], links: dict[str, Any]) -> Iterator[Closure]:
        """Return the connections; mark joints that follow others in `joints`."""
        for k, element in enumerate(() if self.is_disabled("equality", "constraint") else part):
            attributes = self.attributes(element, "main", "equality")
            name = attributes.get("name", f"{element.tag}_{k + 1}")
            where = f"{self.file}, <{element.tag}> {name!r}"
            if attributes.get("active", "true") != "true":
                continue
            if element.tag == "joint":
                self._couple(where, attributes, joints)
                continue
            quaternion = self.numbers(where, attributes, "relpose", "0 1 0 0 0 0 0", 7)[3:]
            if element.tag not in ("connect", "weld") or "site1" in attributes or any(quaternion):
                raise InputError(
                    str(where), allowed="joint, connect with anchor, or weld without relpose", state="is not read"
                )
            pair = attributes.get("body1", ""), attributes.get("body2", "world")
            for link in pair:
                if link not in links:
                    raise unknown(f"{where}: body", link, links, (where, "body"))
            place = np.array(self.numbers(where, attributes, "anchor", "" if element.tag == "connect" else "0 0 0", 3))
            yield Closure(name, "spherical" if element.tag == "connect" else "fixed", pair, place)

    def _couple(self, where: str, attributes: Attributes, joints: dict[str, Any]) -> None:
        """Have joint1 follow joint2 in `joints`: x - x0 = a0 + a1 (y - y0), with coordinates x0 and y0 of the file's start."""
        names = [attributes[key] for key in ("joint1", "joint2") if key in attributes or key == "joint1"]
        for key, name in zip(("joint1", "joint2"), names, strict=False):
            if name not in joints:
                raise unknown(f"{where}: {key}", name, joints, (where, key))
        terms = self.numbers(where, attributes, "polycoef", "0 1 0 0 0")
        if any(terms[2:]) and len(names) == 2:
            raise InputError(
                (str(where), "polycoef"),
                terms,
                "linear",
                hint="zero for the third number and the following",
                noun=f"{where}: polycoef",
                shown=f"{terms}",
            )
        follower = joints[names[0]]
        if follower.mimics is not None:
            raise wrong_entry(
                where, f"joint1 = {names[0]!r} follows two joints", key="joint1", hint="one <joint> for each joint1"
            )
        constant, ratio = ([*terms, 0.0, 0.0])[:2]
        if len(names) == 1:
            mimic = Mimic("", 0.0, follower.start + constant)
        else:
            mimic = Mimic(names[1], ratio, follower.start + constant - ratio * joints[names[1]].start)
        joints[names[0]] = replace(follower, mimics=mimic)

    def _actuators(self, part: ET.Element, joints: dict[str, Any]) -> Iterator[Actuator]:
        for k, element in enumerate(part):
            attributes = self.attributes(element, "main", "actuator")
            name, joint = (
                attributes.get("name", f"{element.tag}_{k + 1}"),
                attributes.get("joint", attributes.get("jointinparent")),
            )
            where = f"{self.file}, {element.tag} {name!r}"
            if joint is not None and joint not in joints:
                raise unknown(f"{where}: joint", joint, joints, (where, "joint"))
            types = [attributes.get(key) for key in ("gaintype", "biastype", "dyntype")]
            simple = types[0] in (None, "fixed") and types[1] in (None, "none", "affine") and types[2] in (None, "none")
            filtered = {"timeconst", "dampratio"} & attributes.keys() and element.tag == "position"
            moves = joint is not None and joints[joint].kind in ("revolute", "prismatic")
            if joint is None or not moves or element.tag not in ACTUATORS or not simple or filtered:
                self.note_omitted("actuators", name)
                continue
            gain, bias = 1.0, (0.0, 0.0, 0.0)
            if element.tag == "general":
                gain = self.numbers(where, attributes, "gainprm", "1")[0]
                terms = [*self.numbers(where, attributes, "biasprm", "0"), 0.0, 0.0]
                bias = (terms[0], terms[1], terms[2]) if types[1] == "affine" else bias
            elif element.tag == "position":
                gain, damping = self.number(where, attributes, "kp", "1"), self.number(where, attributes, "kv")
                bias = (0.0, -gain, -damping)
            elif element.tag == "velocity":
                gain = self.number(where, attributes, "kv", "1")
                bias = (0.0, 0.0, -gain)
            gear = self.numbers(where, attributes, "gear", "1")[0]
            limits = (
                None if self.is_disabled("clampctrl") else self.limits(where, attributes, "ctrlrange", "ctrllimited")
            )
            yield Actuator(
                name, joint, gear, gain, bias, limits, self.limits(where, attributes, "forcerange", "forcelimited")
            )
