"""Values in MJCF files: attributes with defaults of their classes, numbers, angles, orientations, limits; inertia of shapes.

Source: mujoco.readthedocs.io, XML reference. Checked in tests/extensions/robots/test_mjcf.py.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np

from torchmbd.errors import InputError, unknown, wrong_entry
from torchmbd.extensions.robots.mjcf_words import KNOWN, SECTIONS
from torchmbd.extensions.robots.tree import Pose, numbers, rotation

ACTUATORS = ("motor", "position", "velocity", "general")
COMPILER = {"balanceinertia": "false", "boundmass": "0", "boundinertia": "0", "coordinate": "local"}
SHAPES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}  # sizes of each
Attributes = dict[str, str]


class Values:
    """The values of one file.

    compiler, option, flags   attributes of all elements of these names
    angle                     unit of angles [rad]
    classes                   class -> tag -> attributes
    omitted                   kind of elements or attributes that are left out -> names
    """

    def __init__(self, file: str, root: ET.Element) -> None:
        self.file, self.root = file, root
        self.compiler, self.option, self.flags = (
            {key: x for element in root.iterfind(path) for key, x in element.attrib.items()}
            for path in ("compiler", "option", "option/flag")
        )
        for key, allowed in COMPILER.items():
            if (value := self.compiler.get(key, allowed)) != allowed:
                raise InputError((file, "compiler", key), value, repr(allowed), noun=f"{file}, compiler: {key}")
        for key in ("passive", "spring", "damper", "actuation"):
            if self.is_disabled(key):
                raise InputError((file, "option", key), "disable", "'enable'", noun=f"{file}, option: flag {key}")
        self.angle = 1.0 if self.compiler.get("angle") == "radian" else math.pi / 180.0
        self.sequence = self.compiler.get("eulerseq", "xyz")
        if len(self.sequence) != 3 or set(self.sequence.lower()) - set("xyz"):
            raise InputError(
                (file, "compiler", "eulerseq"), self.sequence, "three of xyz, XYZ", noun=f"{file}, compiler: eulerseq"
            )
        self.classes: dict[str, dict[str, Attributes]] = {"main": {}}
        self.omitted: dict[str, list[str]] = {}
        for element in root:
            if element.tag not in SECTIONS:
                raise unknown(f"{file}: element", element.tag, SECTIONS, (file, element.tag))
        for element in root.iter():
            for key in element.attrib.keys() - KNOWN.get(element.tag, element.attrib.keys()):
                self.note_omitted(f"{key} of <{element.tag}>", element.get("name", ""))
        for element in root.findall("default"):
            self.add_defaults(element, None)

    def is_disabled(self, *flags: str) -> bool:
        """True if an option disables one of these flags."""
        return any(self.flags.get(flag) == "disable" for flag in flags)

    def note_omitted(self, kind: str, name: str) -> None:
        """Note that an element or attribute of this kind is left out."""
        self.omitted.setdefault(kind, []).append(name)

    def add_defaults(self, element: ET.Element, parent: str | None) -> None:
        name = "main" if parent is None else element.get("class", "")
        if not name:
            raise wrong_entry(self.file, "a <default> in another has no class", key="default")
        defaults = self.classes[name] = {tag: dict(x) for tag, x in self.classes[parent or "main"].items()}
        for child in element:
            if child.tag != "default":
                tag = "actuator" if child.tag in ACTUATORS else child.tag
                defaults[tag] = defaults.get(tag, {}) | {key: x for key, x in child.attrib.items() if key != "class"}
        for child in element.findall("default"):
            self.add_defaults(child, name)

    def attributes(self, element: ET.Element, inherited: str, tag: str = "") -> Attributes:
        """Return the attributes of an element, with the defaults of its class."""
        name = element.get("class", inherited)
        if name not in self.classes:
            raise unknown(f"{self.file}, <{element.tag}>: class", name, self.classes, (self.file, element.tag, "class"))
        return self.classes[name].get(tag or element.tag, {}) | element.attrib

    def numbers(
        self, where: str, attributes: Attributes, key: str, default: str, count: int | None = None
    ) -> list[float]:
        return numbers(where, key, attributes.get(key, default), count)

    def number(self, where: str, attributes: Attributes, key: str, default: str = "0") -> float:
        return self.numbers(where, attributes, key, default, 1)[0]

    def terms(self, where: str, attributes: Attributes, key: str) -> tuple[float, ...]:
        """Return the factors of a polynomial, of the first power first: one to three numbers."""
        factors = self.numbers(where, attributes, key, "0")
        if not 1 <= len(factors) <= 3:
            raise InputError((str(where), key), attributes.get(key), "one to three numbers", noun=f"{where}: {key}")
        return tuple(factors)

    def direction(self, where: str, attributes: Attributes, key: str, default: str) -> np.ndarray:
        vector = np.array(self.numbers(where, attributes, key, default, 3))
        length = float(np.linalg.norm(vector))
        if not length > 1e-9:
            raise InputError((str(where), key), attributes.get(key), "a direction", noun=f"{where}: {key}")
        return vector / length

    def pose(self, where: str, attributes: Attributes) -> Pose:
        return Pose(np.array(self.numbers(where, attributes, "pos", "0 0 0", 3)), self.axes(where, attributes))

    def axes(self, where: str, attributes: Attributes) -> np.ndarray:
        if "axisangle" in attributes:
            *axis, angle = self.numbers(where, attributes, "axisangle", "", 4)
            along = self.direction(where, {"axisangle": " ".join(map(repr, axis))}, "axisangle", "")
            return rotation(along, angle * self.angle)
        if "xyaxes" in attributes:
            x, y = np.array(self.numbers(where, attributes, "xyaxes", "", 6)).reshape(2, 3)
            z = np.cross(x, y)
            if not min(np.linalg.norm(x), np.linalg.norm(z)) > 1e-9:
                raise InputError(
                    (str(where), "xyaxes"), attributes["xyaxes"], "two directions", noun=f"{where}: xyaxes"
                )
            x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
            return np.stack([x, np.cross(z, x), z], axis=1)
        if "zaxis" in attributes:
            return axes_along_z(self.direction(where, attributes, "zaxis", ""))
        if "euler" in attributes:
            axes = np.eye(3)
            for letter, angle in zip(self.sequence, self.numbers(where, attributes, "euler", "", 3), strict=True):
                turned = rotation(np.eye(3)["xyz".index(letter.lower())], angle * self.angle)
                axes = axes @ turned if letter.islower() else turned @ axes
            return axes
        w, *v = self.numbers(where, attributes, "quat", "1 0 0 0", 4)
        length, sine = math.hypot(w, *v), math.hypot(*v)
        if not length > 1e-9:
            raise InputError(
                (str(where), "quat"), attributes["quat"], "a quaternion that is not zero", noun=f"{where}: quat"
            )
        return rotation(np.array(v) / sine, 2.0 * math.atan2(sine, w)) if sine else np.eye(3)

    def limits(self, where: str, attributes: Attributes, key: str, limited: str) -> tuple[float, float] | None:
        """Return lower and upper limit in the unit of the file; None without limits."""
        lower, upper = self.numbers(where, attributes, key, "0 0", 2)
        switch = attributes.get(limited, "auto")
        automatic = self.compiler.get("autolimits", "true") == "true" and lower < upper
        if switch == "false" or (switch == "auto" and not automatic):
            return None
        if not lower < upper:
            raise InputError(
                (str(where), key), attributes.get(key), "must have lower below upper", noun=f"{where}: {key}"
            )
        return lower, upper


def axes_along_z(z: np.ndarray) -> np.ndarray:
    """Return axes whose z is the direction z, by the smallest rotation."""
    across = np.array([-z[1], z[0], 0.0])
    sine = float(np.linalg.norm(across))
    if sine < 1e-12:
        return np.eye(3) if z[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    return rotation(across / sine, math.atan2(sine, z[2]))


def shape_inertia(kind: str, size: list[float]) -> tuple[float, list[float]]:
    """Return volume [m3] and inertia over mass [m2] about the axes of a shape."""
    r, h = size[0], 0.0 if kind == "sphere" else size[1]
    if kind in ("box", "ellipsoid"):
        x, y, z = (half * half for half in size[:3])
        share, volume = (1.0 / 3.0, 8.0) if kind == "box" else (0.2, 4.0 / 3.0 * math.pi)
        return volume * math.prod(size[:3]), [share * (y + z), share * (x + z), share * (x + y)]
    if kind == "cylinder":
        across = r * r / 4.0 + h * h / 3.0
        return 2.0 * math.pi * r * r * h, [across, across, 0.5 * r * r]
    rod, ball = 2.0 * math.pi * r * r * h, 4.0 / 3.0 * math.pi * r**3
    across = rod * (r * r / 4.0 + h * h / 3.0) + ball * (0.4 * r * r + h * h + 0.75 * h * r)
    along = rod * 0.5 * r * r + ball * 0.4 * r * r
    return rod + ball, [across / (rod + ball)] * 2 + [along / (rod + ball)]
