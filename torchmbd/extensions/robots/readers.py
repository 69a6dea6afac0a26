"""Systems out of robot files.

Checked in tests/extensions/robots/test_robot.py, test_robot_mjcf.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchmbd.extensions.robots.assembly import robot
from torchmbd.extensions.robots.mjcf import mjcf_robot
from torchmbd.extensions.robots.urdf import urdf_robot
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.system import System


def read_urdf(
    path: str | Path, flexible: Mapping[str, FlexibleBody] | None = None, fixed_base: bool = True, **options: Any
) -> System:
    """A robot of a URDF file: links as rigid bodies, or as flexible ones whose mesh is in the frame of the link.

    path         the file
    flexible     link name -> body in its place
    fixed_base   True: the root link is the ground, False: a free body
    options      positions, velocities, drives, locked, gravity, stop_stiffness, stop_damping, friction_speed
                 (extensions/robots/assembly.py)
    Raises InputError that names file, element and value.

    >>> text = '''<robot name="pendulum"><link name="base"/>
    ...   <link name="rod"><inertial><origin xyz="0 0 -1"/><mass value="2"/>
    ...     <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
    ...   <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>'''
    >>> with open("pendulum.urdf", "w") as file:
    ...     _ = file.write(text)
    >>> mbd.io.read_urdf("pendulum.urdf", positions={"hinge": 0.3}).joints
    (Revolute(ground.at(0, 0, 0), rod.at(0, 0, 0)),)
    """
    return System(**robot(urdf_robot(path), flexible or {}, fixed_base, **options))


def read_mjcf(path: str | Path, flexible: Mapping[str, FlexibleBody] | None = None, **options: Any) -> System:
    """A mechanism of MuJoCo's format: bodies, joints, springs, actuators on joints, connections (extensions/robots/mjcf.py).

    path       the file
    flexible   body name -> body in its place, whose mesh is in the frame of the body
    options    as in read_urdf, and controls: actuator name -> number or function of time; gravity is that of the file
    Raises InputError that names file, element and value.

    >>> text = '''<mujoco><worldbody><body name="bob"><joint name="hinge" axis="0 1 0"/>
    ...   <geom type="sphere" size="0.1" pos="0 0 -1" mass="2"/></body></worldbody></mujoco>'''
    >>> with open("pendulum.xml", "w") as file:
    ...     _ = file.write(text)
    >>> mbd.io.read_mjcf("pendulum.xml").body("bob").mass.item()
    2.0
    """
    file = mjcf_robot(path)
    options.setdefault("gravity", file.gravity)
    return System(**robot(file, flexible or {}, **options))
