"""Grippers and robots whose joints mimic others (URDF, unedited), against MuJoCo. `python -m experiments.peers.mimic_robots`

    ROBOTIQ_85           the folder of the repository a-price/robotiq_arg85_description
    EXAMPLE_ROBOT_DATA   the folder `robots` of the repository Gepetto/example-robot-data

A joint that mimics another has q_i = r q_j + o. So all coordinates are q = N s + o, with those of the other joints s. MuJoCo's
equality is a soft constraint with two coordinates. Its limit of infinite stiffness is the projection of MuJoCo's equations:

    s'' = (N' M N)^-1 N' f        M = mj_fullM,  f = qfrc_passive - qfrc_bias

Positions within the limits and velocities are drawn. Compared are the accelerations of all links at the start, and the places
of their origins after 0.2 s, which a Runge-Kutta method of fourth order makes of the projection. Limits and dry friction are
left out in both, and shapes are taken away from MuJoCo's model.
Needs the package `mujoco`. Checked in tests/experiments/test_mimic_robots.py.
"""

from __future__ import annotations

import importlib
import importlib.util
import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from experiments.peers.mujoco_models import apart
from experiments.peers.robots import STEP, folder
from torchmbd.extensions.robots.forces import MOVING
from torchmbd.extensions.robots.tree import Robot
from torchmbd.extensions.robots.urdf import urdf_robot

FILES = {
    "ROBOTIQ_85": ("robots/robotiq_arg85_description.URDF",),
    "EXAMPLE_ROBOT_DATA": (
        "panda_description/urdf/panda.urdf",
        "pr2_description/urdf/pr2.urdf",
        "talos_data/robots/talos_full_v2.urdf",
        "baxter_description/urdf/baxter.urdf",
        "tiago_pro_description/robots/tiago_pro.urdf",
    ),
}
DURATION, STEPS = 0.2, 2000  # s; of the Runge-Kutta method
Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Comparison:
    """Numbers of joints and of those that mimic others; differences of accelerations, and of places after DURATION [m]."""

    joints: int
    mimics: int
    turning: float
    moving: float
    places: float


def files() -> list[Path]:
    """Files of FILES that are on this machine."""
    bases = {variable: folder(variable) for variable in FILES}
    paths = [base / name for variable, base in bases.items() if base is not None for name in FILES[variable]]
    return [path for path in paths if path.is_file()]


class Projection:
    """MuJoCo's model of a robot, with its equations projected on the coordinates of the joints that mimic none."""

    def __init__(self, path: Path, robot: Robot, gravity: Any) -> None:
        self.program: Any = importlib.import_module("mujoco")
        root = ElementTree.parse(path).getroot()
        for link in root.findall("link"):
            for shape in (*link.findall("visual"), *link.findall("collision")):
                link.remove(shape)
        for element in root.findall("mujoco"):
            root.remove(element)
        options = ElementTree.SubElement(root, "mujoco")
        ElementTree.SubElement(options, "compiler", fusestatic="true", balanceinertia="false")
        self.model = self.program.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
        self.model.opt.disableflags |= self.program.mjtDisableBit.mjDSBL_CONSTRAINT
        self.model.opt.gravity[:] = gravity
        self.data = self.program.MjData(self.model)
        joints = {joint.name: joint for joint in robot.joints}
        self.names = [self.model.joint(k).name for k in range(self.model.njnt)]
        self.leaders = [name for name in self.names if joints[name].mimics is None]
        self.N, self.o = np.zeros((len(self.names), len(self.leaders))), np.zeros(len(self.names))
        for i, name in enumerate(self.names):
            ratio, offset = 1.0, 0.0
            while (mimic := joints[name].mimics) is not None:
                offset, ratio, name = offset + ratio * mimic.offset, ratio * mimic.ratio, mimic.joint
            self.N[i, self.leaders.index(name)], self.o[i] = ratio, offset

    def acceleration(self, s: Array, rate: Array) -> Array:
        """Accelerations of the leaders' coordinates; `data` has those of all."""
        data, model = self.data, self.model
        data.qpos[:], data.qvel[:] = self.N @ s + self.o, self.N @ rate
        self.program.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        self.program.mj_fullM(model, data, M)
        f = data.qfrc_passive - data.qfrc_bias
        a = np.linalg.solve(self.N.T @ M @ self.N, self.N.T @ f)
        data.qacc[:] = self.N @ a
        self.program.mj_rnePostConstraint(model, data)
        return a

    def move(self, s: Array, rate: Array) -> None:
        """Leave the places of all bodies after DURATION in `data`."""
        n, h = len(s), DURATION / STEPS

        def slope(x: Array) -> Array:
            return np.concatenate([x[n:], self.acceleration(x[:n], x[n:])])

        x = np.concatenate([s, rate])
        for _ in range(STEPS):
            k1 = slope(x)
            k2 = slope(x + 0.5 * h * k1)
            k3 = slope(x + 0.5 * h * k2)
            k4 = slope(x + h * k3)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self.acceleration(x[:n], x[n:])


def draw(robot: Robot, leaders: list[str], seed: int) -> tuple[Array, Array]:
    """Positions in the middle parts of the limits, and velocities of about 1 rad/s or 0.1 m/s."""
    generator, joints = np.random.default_rng(seed), {joint.name: joint for joint in robot.joints}
    s, rate = np.zeros(len(leaders)), np.zeros(len(leaders))
    for k, name in enumerate(leaders):
        lower, upper = joints[name].limits or (-3.0, 3.0)
        lower, upper = max(lower, -3.0), min(upper, 3.0)
        s[k] = 0.5 * (lower + upper) + 0.4 * (upper - lower) * generator.uniform(-1.0, 1.0)
        rate[k] = generator.normal() * (0.1 if joints[name].kind == "prismatic" else 1.0)
    return s, rate


def compared(path: Path, seed: int = 1) -> Comparison:
    """The system of a file beside the projection. InputError where it is refused."""
    robot = urdf_robot(path)
    theirs = Projection(path, robot, (0.0, 0.0, -9.81))
    s, rate = draw(robot, theirs.leaders, seed)
    settings: Any = {
        "positions": dict(zip(theirs.leaders, s.tolist(), strict=True)),
        "velocities": dict(zip(theirs.leaders, rate.tolist(), strict=True)),
    }
    whole = mbd.io.read_urdf(path, stop_stiffness=None, gravity=(0.0, 0.0, -9.81), **settings)
    forces = [force for force in whole.forces if not force.name.endswith("_friction")]
    system = mbd.System(list(whole.bodies), list(whole.joints), forces, gravity=(0.0, 0.0, -9.81))
    motion = mbd.simulate(system, STEP, steps=1, gradients="none", backend="eager")
    theirs.acceleration(s, rate)
    turning, moving = apart(theirs.program, theirs.model, theirs.data, system, motion, (0.0, 0.0, -9.81))
    motion = mbd.simulate(system, DURATION, steps=2, method="dopri8", gradients="none")
    theirs.move(s, rate)
    places = 0.0
    for body in system.bodies:
        number = theirs.program.mj_name2id(theirs.model, theirs.program.mjtObj.mjOBJ_BODY, body.name)
        if number >= 0:
            place = motion.body(body.name).at((0.0, 0.0, 0.0)).position[0, -1].numpy()
            places = max(places, float(np.abs(place - theirs.data.xpos[number]).max()))
    return Comparison(
        sum(joint.kind in MOVING for joint in robot.joints),
        sum(joint.mimics is not None for joint in robot.joints),
        turning,
        moving,
        places,
    )


def main() -> None:
    """Compare all files that are found."""
    torch.set_num_threads(1)
    if importlib.util.find_spec("mujoco") is None:
        print("mujoco is not installed; nothing was run")
        return
    print(f"{'file':36}{'joints':>8}{'mimics':>8}{'spin rates':>12}{'accelerations':>15}{'places [m]':>13}")
    for path in files():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                x = compared(path)
            except (mbd.InputError, ValueError) as error:  # ValueError: of MuJoCo
                print(f"{path.name:36}refused: {str(error).splitlines()[0]}", flush=True)
                continue
        print(f"{path.name:36}{x.joints:8}{x.mimics:8}{x.turning:12.1e}{x.moving:15.1e}{x.places:13.1e}", flush=True)


if __name__ == "__main__":
    main()
