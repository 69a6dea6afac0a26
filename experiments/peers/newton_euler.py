"""Accelerations of a tree of rigid links by the recursion of Newton and Euler, from a URDF file: what mbd.io.read_urdf is
compared with. It shares no code with torchmbd, not the reading of the file either.

Outwards along the tree angular velocity w, its rate dw and acceleration dv of each link's origin, all in the axes of the link;
inwards forces f and moments n; a joint's coordinate feels their part along its axis. Masses from unit accelerations:

    tau(q, rate, a) = M(q) a + h(q, rate)        a = M^-1 (-h - losses)

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 5.3.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

FRICTION_SPEED = 0.01  # [rad/s, m/s], as mbd.io.read_urdf has it


@dataclass
class Joint:
    """A joint and the link that it carries, in the frame of this link; coordinate: its number, -1 where it has none."""

    name: str
    link: str
    parent: int
    kind: str
    place: np.ndarray
    axes: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float]
    damping: float
    friction: float
    coordinate: int
    mass: float
    center: np.ndarray
    inertia: np.ndarray


class Tree:
    """Links of a file whose root stands still; `locked` joints stay at the positions that are given."""

    def __init__(self, path: Path, locked: Collection[str] = ()):
        root = ElementTree.parse(path).getroot()
        links = {element.get("name", ""): element for element in root.findall("link")}
        joints = root.findall("joint")
        children = {_end(joint, "child") for joint in joints}
        [base] = [name for name in links if name not in children]
        self.joints: list[Joint] = []
        numbers, pending = {base: -1}, [base]
        while pending:
            parent = pending.pop(0)
            for element in joints:
                if _end(element, "parent") != parent:
                    continue
                child = _end(element, "child")
                self.joints.append(self._joint(element, links[child], numbers[parent], locked))
                numbers[child] = len(self.joints) - 1
                pending.append(child)
        self.moving = [joint for joint in self.joints if joint.coordinate >= 0]

    def _joint(self, element: ElementTree.Element, link: ElementTree.Element, parent: int, locked: Collection[str]):
        name, kind = element.get("name", ""), element.get("type", "")
        if kind not in ("revolute", "continuous", "prismatic", "fixed"):
            raise ValueError(f"joint {name!r} is {kind}")
        place, axes = _pose(element.find("origin"))
        axis = _vector(element.find("axis"), "xyz", "1 0 0")
        limit, dynamics, inertial = element.find("limit"), element.find("dynamics"), link.find("inertial")
        limits = (-math.pi, math.pi)
        if kind != "continuous" and limit is not None:
            limits = _number(limit, "lower"), _number(limit, "upper")
        free = kind != "fixed" and name not in locked
        center, turned = _pose(None if inertial is None else inertial.find("origin"))
        J = np.zeros((3, 3))
        if inertial is not None:
            for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
                J[i, j] = J[j, i] = _number(inertial.find("inertia"), f"i{'xyz'[i]}{'xyz'[j]}")
        return Joint(
            name,
            link.get("name", ""),
            parent,
            kind,
            place,
            axes,
            axis / max(float(np.linalg.norm(axis)), 1e-12),
            limits,
            _number(dynamics, "damping"),
            _number(dynamics, "friction"),
            sum(joint.coordinate >= 0 for joint in self.joints) if free else -1,
            0.0 if inertial is None else _number(inertial.find("mass"), "value"),
            center,
            turned @ J @ turned.T,
        )

    def accelerations(
        self, positions: Mapping[str, float], velocities: Mapping[str, float], gravity: float = 9.81
    ) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
        """Of the coordinates, and by link: of the origin in ground axes, and of the angular velocity in the link's axes."""
        q = {joint.name: positions.get(joint.name, 0.0) for joint in self.joints}
        rate = np.array([velocities.get(joint.name, 0.0) for joint in self.moving])
        zero, unit = np.zeros(len(rate)), np.eye(len(rate))
        bias, _ = self._recursion(q, rate, zero, gravity)
        M = np.stack([self._recursion(q, zero, e, 0.0)[0] for e in unit], axis=1)
        damping = np.array([joint.damping for joint in self.moving])
        friction = np.array([joint.friction for joint in self.moving])
        losses = damping * rate + friction * np.tanh(rate / FRICTION_SPEED)
        a = np.linalg.solve(M, -bias - losses)
        return a, self._recursion(q, rate, a, gravity)[1]

    def _recursion(
        self, q: Mapping[str, float], rate: np.ndarray, a: np.ndarray, gravity: float
    ) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
        """Forces of the coordinates, and the accelerations of the links."""
        up = np.array([0.0, 0.0, gravity])
        w, dw, dv, A, R, p, f, n = ([] for _ in range(8))
        accelerations = {}
        for joint in self.joints:
            k, parent = joint.coordinate, joint.parent
            s, ds = (rate[k], a[k]) if k >= 0 else (0.0, 0.0)
            slides, coordinate = joint.kind == "prismatic", q[joint.name] if joint.kind != "fixed" else 0.0
            turn = np.eye(3) if slides else Rotation.from_rotvec(joint.axis * coordinate).as_matrix()
            R.append(joint.axes @ turn)
            p.append(joint.place + joint.axes @ joint.axis * coordinate if slides else joint.place)
            w0, dw0, dv0, A0 = (
                x[parent] if parent >= 0 else y for x, y in ((w, 0 * up), (dw, 0 * up), (dv, up), (A, np.eye(3)))
            )
            B = R[-1].T
            carried = dv0 + np.cross(dw0, p[-1]) + np.cross(w0, np.cross(w0, p[-1]))
            w.append(B @ w0 + (0.0 if slides else joint.axis * s))
            dw.append(B @ dw0 + (0.0 if slides else joint.axis * ds + np.cross(B @ w0, joint.axis * s)))
            along = joint.axis * ds + 2.0 * np.cross(B @ w0, joint.axis * s) if slides else 0.0
            dv.append(B @ carried + along)
            A.append(A0 @ R[-1])
            c, m, J = joint.center, joint.mass, joint.inertia
            force = m * (dv[-1] + np.cross(dw[-1], c) + np.cross(w[-1], np.cross(w[-1], c)))
            f.append(force)
            n.append(J @ dw[-1] + np.cross(w[-1], J @ w[-1]) + np.cross(c, force))
            accelerations[joint.link] = A[-1] @ dv[-1] - up, dw[-1]
        tau = np.zeros(len(rate))
        for i in reversed(range(len(self.joints))):
            joint, parent = self.joints[i], self.joints[i].parent
            if joint.coordinate >= 0:
                tau[joint.coordinate] = joint.axis @ (f[i] if joint.kind == "prismatic" else n[i])
            if parent >= 0:
                f[parent] = f[parent] + R[i] @ f[i]
                n[parent] = n[parent] + R[i] @ n[i] + np.cross(p[i], R[i] @ f[i])
        return tau, accelerations


def _end(joint: ElementTree.Element, end: str) -> str:
    return joint.find(end).get("link")  # type: ignore[union-attr,return-value]


def _vector(element: ElementTree.Element | None, key: str, default: str) -> np.ndarray:
    return np.array([float(x) for x in (default if element is None else element.get(key, default)).split()])


def _number(element: ElementTree.Element | None, key: str) -> float:
    return 0.0 if element is None else float(element.get(key, "0"))


def _pose(element: ElementTree.Element | None) -> tuple[np.ndarray, np.ndarray]:
    turned = Rotation.from_euler("xyz", _vector(element, "rpy", "0 0 0")).as_matrix()
    return _vector(element, "xyz", "0 0 0"), turned
