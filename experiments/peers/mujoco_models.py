"""Public mechanisms in MuJoCo's format, unedited, against MuJoCo. `python -m experiments.peers.mujoco_models`

    MUJOCO_MODELS       the folder `model` of the repository google-deepmind/mujoco
    DM_CONTROL_SUITE    the folder `dm_control/suite` of google-deepmind/dm_control
    UNITREE_ROBOTS      the folder `unitree_robots` of unitreerobotics/unitree_mujoco

Positions within the limits, velocities and controls are drawn; compared are the accelerations of all bodies, of their origins
and of their angular velocities.

MuJoCo runs without what mbd.io.read_mjcf leaves out and says so: armature, contact, tendons, actuators that are not on
joints, limits of their sum, forces of a fluid; and without limits, dry friction and equality, which are constraints of its
own kind there. Shapes that are meshes are taken away: their files may lack, and bodies have their inertia without them.
Needs the package `mujoco`. Checked in tests/experiments/test_mujoco_models.py.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from experiments.peers.robots import STEP, Compared, folder, row
from torchmbd.extensions.robots.forces import MOVING, identifier
from torchmbd.extensions.robots.mjcf import mjcf_robot
from torchmbd.extensions.robots.tree import Robot

FOLDERS = ("MUJOCO_MODELS", "DM_CONTROL_SUITE", "UNITREE_ROBOTS")
SHOWN = (
    "humanoid.xml",
    "acrobot.xml",
    "cheetah.xml",
    "humanoid_CMU.xml",
    "h1.xml",
    "g1_29dof.xml",
    "go2.xml",
    "b2w.xml",
)


def model(path: Path, robot: Robot) -> Any:
    """MuJoCo's model of a file, with what `kept` has of it."""
    program: Any = importlib.import_module("mujoco")
    spec = program.MjSpec.from_file(str(path))
    meshes = [geom for geom in spec.geoms if geom.type == program.mjtGeom.mjGEOM_MESH]
    for item in (*meshes, *spec.meshes, *spec.materials, *spec.textures):
        spec.delete(item)
    for item in (*spec.geoms, *spec.sites):
        item.material = ""
    for light in spec.lights:
        light.texture = ""
    compiled = spec.compile()
    for numbers in (compiled.dof_armature, compiled.body_gravcomp, compiled.tendon_stiffness, compiled.tendon_damping):
        numbers[:] = 0.0
    compiled.jnt_actfrclimited[:] = False
    compiled.opt.density = compiled.opt.viscosity = 0.0
    compiled.opt.disableflags |= program.mjtDisableBit.mjDSBL_CONSTRAINT
    names = {actuator.name for actuator in robot.actuators}
    for k in range(compiled.nu):
        if compiled.actuator(k).name not in names:
            compiled.actuator_gainprm[k] = compiled.actuator_biasprm[k] = 0.0
    program.mj_setConst(compiled, program.MjData(compiled))
    return compiled


def compared(path: Path, seed: int = 1) -> Compared:
    """The system of a file next to MuJoCo; joints that follow others are locked. InputError where it is refused."""
    program: Any = importlib.import_module("mujoco")
    robot = mjcf_robot(path)
    theirs = model(path, robot)
    data, generator = program.MjData(theirs), np.random.default_rng(seed)
    order = list(robot.links)  # as in the file, and as MuJoCo counts
    joints = sorted(
        (joint for joint in robot.joints if joint.kind in MOVING), key=lambda joint: order.index(joint.child)
    )
    numbers = [k for k in range(theirs.njnt) if theirs.jnt_type[k] >= int(program.mjtJoint.mjJNT_SLIDE)]
    places: dict[str, float] = {}
    rates: dict[str, float] = {}
    for joint, number in zip(joints, numbers, strict=True):
        lower, upper = joint.limits or (-3.0, 3.0)
        lower, upper = max(lower, -3.0), min(upper, 3.0)
        places[joint.name] = 0.5 * (lower + upper) + 0.4 * (upper - lower) * generator.uniform(-1.0, 1.0)
        data.qpos[theirs.jnt_qposadr[number]] = places[joint.name]
        if not joint.mimics:
            rates[joint.name] = generator.normal() * (0.1 if joint.kind == "prismatic" else 1.0)
            data.qvel[theirs.jnt_dofadr[number]] = rates[joint.name]
    controls = {actuator.name: generator.uniform(*(actuator.limits or (-1.0, 1.0))) for actuator in robot.actuators}
    for k in range(theirs.nu):
        data.ctrl[k] = controls.get(theirs.actuator(k).name, 0.0)
    locked = [joint.name for joint in joints if joint.mimics]
    settings: Any = {"positions": places, "velocities": rates, "controls": controls, "locked": locked}
    system = mbd.io.read_mjcf(path, stop_stiffness=None, **settings)
    closures = {identifier(closure.name) for closure in robot.closures}
    free = [identifier(joint.child) for joint in robot.joints if joint.kind == "floating"]
    system = mbd.System(
        list(system.bodies),
        [joint for joint in system.joints if joint.name not in closures],
        [force for force in system.forces if not force.name.endswith("_friction")],
        gravity=robot.gravity,
        free=free,
    )
    motion = mbd.simulate(system, STEP, steps=1, gradients="none", backend="eager")
    program.mj_forward(theirs, data)
    program.mj_rnePostConstraint(theirs, data)
    turning, moving = apart(program, theirs, data, system, motion, robot.gravity)
    stops = sum(joint.limits is not None for joint in joints)
    return Compared(len(rates), stops, turning, moving)


def apart(
    program: Any, theirs: Any, data: Any, system: mbd.System, motion: Any, gravity: Sequence[float]
) -> tuple[float, float]:
    """Largest differences of the bodies' rates of spin and of their accelerations at the start, over the largest of MuJoCo.

    data has MuJoCo's accelerations (mj_rnePostConstraint).
    """
    turning, moving, largest = 0.0, 0.0, [1.0, 1.0]
    # Links between the joints of one body, and bodies without a name, are not compared.
    bodies = {identifier(theirs.body(k).name): k for k in range(theirs.nbody) if theirs.body(k).name}
    if not bodies.keys() & {body.name for body in system.bodies}:
        raise mbd.InputError("bodies", allowed="must have names", state="that move have no names")
    for body in system.bodies:
        if body.name not in bodies:
            continue
        number, acceleration = bodies[body.name], np.zeros(6)
        program.mj_objectAcceleration(theirs, data, program.mjtObj.mjOBJ_XBODY, number, acceleration, 0)
        spin, place = data.xmat[number].reshape(3, 3).T @ acceleration[:3], acceleration[3:] + np.array(gravity)
        view = motion.body(body.name)
        ours = view.at((0.0, 0.0, 0.0)).acceleration[0, 0].numpy(), view.omega_rate[0, 0].numpy()
        moving = max(moving, float(np.abs(ours[0] - place).max()))
        turning = max(turning, float(np.abs(ours[1] - spin).max()))
        largest = [max(x, float(np.abs(y).max())) for x, y in zip(largest, (place, spin), strict=True)]
    return turning / largest[1], moving / largest[0]


def main() -> None:
    """Compare all files that are found."""
    torch.set_num_threads(1)
    if importlib.util.find_spec("mujoco") is None:
        print("mujoco is not installed; nothing was run")
        return
    print(f"{'file':34}{'coordinates':>12}{'limits':>7}{'spin rates':>14}{'accelerations':>15}")
    read: list[Compared] = []
    refused: dict[str, list[str]] = {}
    for variable in FOLDERS:
        if (base := folder(variable)) is None:
            print(f"{variable} names no folder")
            continue
        for path in sorted(base.rglob("*.xml")):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    read.append(comparison := compared(path))
            except mbd.InputError as error:
                why = re.sub(r"^[^:<]*?(, body .*?: |: |, (?=<))", "", str(error).partition(": must ")[0])
                refused.setdefault(re.sub(r" '.*?'", "", why), []).append(path.name)
            except ValueError as error:  # of MuJoCo
                why = re.sub(r" '.*?'.*|^Error: ", "", str(error).splitlines()[0])
                refused.setdefault(f"by MuJoCo: {why}", []).append(path.name)
            else:
                if path.name in SHOWN:
                    print(row(path.name, comparison), flush=True)
    if read:
        keys = ("coordinates", "stops", "turning", "moving")
        print(row(f"largest of {len(read)} files", Compared(*(max(getattr(x, key) for x in read) for key in keys))))
    print(f"refused, {sum(map(len, refused.values()))} files:")
    for why, names in sorted(refused.items(), key=lambda item: -len(item[1])):
        print(f"  {len(names):3}  {why}, {names[0]}")


if __name__ == "__main__":
    main()
