"""The slider-crank with a soft rod of MuJoCo's models, as exact beams of two codes.
`python -m experiments.peers.soft_slider_crank`

Data of model/flex/mechanisms/slidercrank.xml of the repository google-deepmind/mujoco: a crank of 0.18 m turned by a torque
50 (2 pi / 3 - speed), a rod of 0.9 m with a section of 60 x 40 mm, 0.15 kg, E = 1 MPa, Poisson 0.25, damping of 10 ms times
the stiffness; both ends of the rod are clamped in fittings that hinges hold to the crank and the slider; dampers in all
joints; gravity. It starts at rest, stretched out. Axes here: x, and y downwards; about z the crank turns from x to y.

    ours     a geometrically exact beam that shears, where the file has 12 bricks, linear in each direction
    Exudyn   its geometrically exact beam of the plane
    MuJoCo   the file unedited, and with more and with quadratic bricks; MUJOCO_MODELS is the folder `model` of the repository

Checked in tests/experiments/test_soft_slider_crank.py.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import math
import os
import re
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchmbd as mbd
from experiments.peers.exudyn_beams import solve
from experiments.peers.exudyn_peer import available, load
from experiments.peers.modal_slider_crank import deflection

CRANK, ROD, WIDTH, HEIGHT, MASS = 0.18, 0.9, 0.06, 0.04, 0.15  # [m], [kg] of the rod
E, POISSON, DAMPING, GRAVITY = 1e6, 0.25, 0.01, 9.81
AREA, SECOND = WIDTH * HEIGHT, WIDTH * HEIGHT**3 / 12.0
SPEED, GAIN = 2.0 * math.pi / 3.0, 50.0  # [rad/s], [N m s/rad]
HINGE, SLIDE = 0.1, 30.0  # dampers [N m s/rad], [N s/m]
SLIDER, FITTING, FITTING_INERTIA = 1.0, 0.05, 2.475e-5  # [kg], [kg], [kg m2] about the hinge
CRANK_MASS, CRANK_CENTER, CRANK_INERTIA = 0.44, 0.09 * 0.02 / 0.44, 6.719549e-3  # center [m]; inertia about the shaft
DURATION = 3.0  # [s], about a turn
MODELS = "MUJOCO_MODELS"


class Turn(NamedTuple):
    """Speed of the crank [rad/s], deflection of the rod's middle from its chord, way of the slider [m]; all [times]."""

    speed: Tensor
    deflection: Tensor
    slider: Tensor


def section() -> Any:
    """The rectangle: y is in the plane of motion, where it has 5/6 of its area in shear."""
    other = WIDTH**3 * HEIGHT / 12.0
    density = MASS / (ROD * AREA)
    return mbd.GivenSection.isotropic(
        E=E, nu=POISSON, density=density, area=AREA, Iyy=other, Izz=SECOND, J=other + SECOND
    )


def system(elements: int = 24) -> mbd.System:
    """The mechanism with an exact beam."""
    ground = mbd.Ground()
    inertia = CRANK_INERTIA - CRANK_MASS * CRANK_CENTER**2
    center = (CRANK_CENTER, 0.0, 0.0)
    crank = mbd.RigidBody("crank", CRANK_MASS, (inertia,) * 3, center=center)
    left, right = (
        mbd.RigidBody(name, FITTING, (FITTING_INERTIA,) * 3, position=(x, 0.0, 0.0))
        for name, x in (("left", CRANK), ("right", CRANK + ROD))
    )
    slider = mbd.RigidBody("slider", SLIDER, (1.0, 1.0, 1.0), position=(CRANK + ROD, 0.0, 0.0))
    line = mbd.BeamLine.straight(ROD, elements)
    rod = mbd.FlexibleBeam("rod", line, section(), position=(CRANK, 0.0, 0.0), damping=DAMPING)
    pins = [
        (ground.at(), crank.at(), "shaft"),
        (crank.at(CRANK, 0.0, 0.0), left.at(), "pin"),
        (slider.at(), right.at(), "end"),
    ]
    joints = [
        *(mbd.Revolute(a, b, axis="z", name=name) for a, b, name in pins),
        mbd.Fixed(left.at(), rod.at("start")),
        mbd.Fixed(right.at(), rod.at("end")),
        mbd.Prismatic(ground.at(), slider.at(), axis="x", name="slide"),
    ]
    forces: list[Any] = [
        mbd.RotationalSpringDamper(a, b, axis="z", damping=HINGE + GAIN * (name == "shaft"), name=f"{name}_damper")
        for a, b, name in pins
    ]
    forces.append(mbd.Torque(crank.at(), (0.0, 0.0, GAIN * SPEED), name="motor"))
    forces.append(mbd.AxialSpringDamper(ground.at(), slider.at(), axis="x", damping=SLIDE, name="guide"))
    bodies = [crank, left, rod, right, slider]
    return mbd.System(bodies, joints, forces, gravity=(0.0, GRAVITY, 0.0))


def ours(steps: int = 3000, elements: int = 24) -> Turn:
    """A turn of the system above."""
    with torch.no_grad():
        motion = mbd.simulate(system(elements), DURATION, steps=steps, gradients="none").require_ok()
    nodes = (0, elements // 2, elements)
    places = torch.stack([motion.body(f"rod_{k}").at().position[0] for k in nodes])
    slider = motion.body("slider").r[0, :, 0] - (CRANK + ROD)
    return Turn(motion.body("crank").omega[0, :, 2], deflection(places), slider)


def exudyn(steps: int = 3000, elements: int = 24) -> Turn:
    """The same of Exudyn's beam. The fittings share the nodes at the ends of the rod; the slider has a coordinate."""
    exu, items = load(), load(".itemInterface")
    mbs: Any = exu.SystemContainer().AddSystem()
    shear = E / (2.0 * (1.0 + POISSON)) * AREA * 5.0 / 6.0
    rigidity = {"bending": E * SECOND, "axial": E * AREA, "shear": shear}
    places = np.linspace(CRANK, CRANK + ROD, elements + 1).tolist()
    nodes = [mbs.AddNode(items.NodeRigidBody2D(referenceCoordinates=[x, 0.0, 0.0])) for x in places]
    bodies = []
    for pair in pairwise(nodes):
        element = items.ObjectBeamGeometricallyExact2D(
            nodeNumbers=list(pair),
            length=ROD / elements,
            massPerLength=MASS / ROD,
            crossSectionInertia=MASS / ROD * SECOND / AREA,
            **{f"{key}Stiffness": x for key, x in rigidity.items()},
            **{f"{key}Damping": DAMPING * x for key, x in rigidity.items()},
        )
        bodies.append(mbs.AddObject(element))
    for node in (nodes[0], nodes[-1]):
        fitting = items.ObjectRigidBody2D(mass=FITTING, inertia=FITTING_INERTIA, nodeNumber=node)
        bodies.append(mbs.AddObject(fitting))
    shaft = mbs.AddNode(items.NodeRigidBody2D(referenceCoordinates=[CRANK_CENTER, 0.0, 0.0]))
    inertia = CRANK_INERTIA - CRANK_MASS * CRANK_CENTER**2
    crank = mbs.AddObject(items.ObjectRigidBody2D(mass=CRANK_MASS, inertia=inertia, nodeNumber=shaft))
    for body in (*bodies, crank):
        heavy = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body))
        mbs.AddLoad(items.LoadMassProportional(markerNumber=heavy, loadVector=[0.0, GRAVITY, 0.0]))
    at = [
        mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=crank, localPosition=[x - CRANK_CENTER, 0.0, 0.0]))
        for x in (0.0, CRANK)
    ]
    still = mbs.AddObject(items.ObjectGround())
    ground = mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=still))
    pin = mbs.AddMarker(items.MarkerNodePosition(nodeNumber=nodes[0]))
    mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=[ground, at[0]]))
    mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=[at[1], pin]))
    way = mbs.AddNode(items.Node1D(referenceCoordinates=[0.0]))
    mbs.AddObject(items.ObjectMass1D(mass=SLIDER, nodeNumber=way))
    fixed = mbs.AddNode(items.NodePointGround())

    def coordinate(node: Any, number: int) -> Any:
        return mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=number))

    for a, b in (((way, 0), (nodes[-1], 0)), ((fixed, 0), (nodes[-1], 1))):
        mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[coordinate(*a), coordinate(*b)]))
    for a, b, damping in (
        ((fixed, 0), (shaft, 2), HINGE + GAIN),
        ((shaft, 2), (nodes[0], 2), HINGE),
        ((fixed, 0), (nodes[-1], 2), HINGE),
        ((fixed, 0), (way, 0), SLIDE),
    ):
        markers = [coordinate(*a), coordinate(*b)]
        mbs.AddObject(items.ObjectConnectorCoordinateSpringDamper(markerNumbers=markers, damping=damping))
    mbs.AddLoad(items.LoadCoordinate(markerNumber=coordinate(shaft, 2), load=GAIN * SPEED))
    kinds = exu.OutputVariableType
    sensors = [
        mbs.AddSensor(items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind))
        for node, kind in (
            *((nodes[k], kinds.Position) for k in (0, elements // 2, -1)),
            (shaft, kinds.AngularVelocity),
        )
    ]
    with contextlib.redirect_stdout(sys.stderr):
        mbs.Assemble()
        if solve(exu, mbs, DURATION, steps, radius=0.6, absolute=1e-6) is None:
            raise RuntimeError("Exudyn does not converge")
    rows = [torch.from_numpy(np.asarray(mbs.GetSensorStoredData(sensor))[:, 1:]) for sensor in sensors]
    places3 = torch.stack(rows[:3])
    return Turn(rows[3][:, 2], deflection(places3), places3[2, :, 0] - (CRANK + ROD))


def mujoco(path: Path, cells: tuple[int, int, int] = (12, 1, 1), kind: str = "trilinear", steps: int = 3000) -> Turn:
    """The file in MuJoCo itself with a division of the rod into bricks, `kind` "trilinear" or "quadratic"."""
    program: Any = importlib.import_module("mujoco")
    text, shape = path.read_text(), " ".join(map(str, cells))
    text = text.replace('dof="trilinear" cellcount="12 1 1"', f'dof="{kind}" cellcount="{shape}"')
    order = 2 if kind == "quadratic" else 1
    nx, ny, nz = (order * count for count in cells)
    ends = {k: [f"rod_{k}_{i}_{j}" for i in range(ny + 1) for j in range(nz + 1)] for k in (0, nx // 2, nx)}
    held = "".join(
        f'<connect body1="{node}" body2="{body}_fitting" anchor="0 0 0"/>'
        for k, body in ((0, "left"), (nx, "right"))
        for node in ends[k]
    )
    text = re.sub("<equality>.*</equality>", f"<equality>{held}</equality>", text, flags=re.DOTALL)
    scene = path.with_name("scene.xml").read_bytes()
    model = program.MjModel.from_xml_string(text, {"scene.xml": scene})
    model.opt.timestep = DURATION / steps
    data = program.MjData(model)
    numbers = {model.body(i).name: i for i in range(model.nbody)}
    program.mj_forward(model, data)
    samples = []
    for step in range(steps + 1):
        if step:
            program.mj_step(model, data)
        program.mj_kinematics(model, data)
        places = [data.xpos[[numbers[node] for node in ends[k]]].mean(0) for k in ends]
        samples.append([data.qvel[0], data.joint("slide").qpos[0], *np.concatenate(places)])
    rows = torch.tensor(np.array(samples))
    x, down = rows[:, 2::3], -rows[:, 4::3]
    bent = deflection(torch.stack([x, down, torch.zeros_like(x)], dim=-1).transpose(0, 1))
    return Turn(rows[:, 0], bent, rows[:, 1])


def models() -> Path | None:
    """The file, if the variable names its folder."""
    named = os.environ.get(MODELS)
    path = Path(named or "") / "flex" / "mechanisms" / "slidercrank.xml"
    return path if named and path.is_file() else None


def main() -> None:
    """Print speed and deflection along a turn."""
    torch.set_num_threads(1)
    print(f"{'at t =':30}" + "".join(f"{f'{0.5 * k:.1f} s':>9}" for k in range(1, 7)))
    _print("ours, 24 elements, 1 ms", ours())
    _print("ours, 48 elements, 0.5 ms", ours(6000, 48))
    if available():
        _print("Exudyn, 24 elements, 1 ms", exudyn())
        _print("Exudyn, 48 elements, 0.5 ms", exudyn(6000, 48))
    if importlib.util.find_spec("mujoco") is not None and (path := models()) is not None:
        _print("MuJoCo, the file: 12 bricks", mujoco(path))
        _print("MuJoCo, 36 bricks", mujoco(path, (36, 1, 1)))
        _print("MuJoCo, 12 quadratic bricks", mujoco(path, kind="quadratic"))


def _print(name: str, turn: Turn) -> None:
    print(name)
    sixth = (len(turn.speed) - 1) // 6
    for label, x, scale, digits in (
        ("speed of the crank [rad/s]", turn.speed, 1.0, 4),
        ("middle of the rod [mm]", turn.deflection, 1e3, 2),
        ("slider [mm]", turn.slider, 1e3, 2),
    ):
        print(f"  {label:28}" + "".join(f"{scale * float(y):9.{digits}f}" for y in x[sixth::sixth]), flush=True)


if __name__ == "__main__":
    main()
