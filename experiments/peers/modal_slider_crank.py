"""A slider-crank of beams of 10 m and 20 m, divided into modal parts, against exact beams of two codes.
`python -m experiments.peers.modal_slider_crank`

Data of demo_MOD_slider_crank.cpp of the repository projectchrono/chrono: square aluminum beams of 0.4 m, the crank in two
parts, the rod in four, ten elements and twelve fixed-interface modes each; damping of 2 ms times the stiffness; a slider of
1 kg; no gravity. The crank turns by 3 pi t^2 / 50 from x for 5 s (then the demo stops it at once, which is left out here). The
repository has no numbers of its own: compared are the deflection of the rod's middle from the chord, and the slider.

    parts    ours: six flexible bodies, linear in their own frames
    exact    ours: two geometrically exact beams of 10 and 20 elements, no modes
    Exudyn   its geometrically exact beams of 20 and 40 elements; they take no damping, so ours have none beside them

Checked in tests/experiments/test_modal_slider_crank.py.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchmbd as mbd
from experiments.peers.exudyn_beams import Rod, exact_beam, solve
from experiments.peers.exudyn_peer import available, load

CRANK, ROD, SIDE = 10.0, 20.0, 0.4  # [m]
E, POISSON, DENSITY, DAMPING = 7e10, 0.31, 2700.0, 0.002
G = E / (2.0 * (1.0 + POISSON))
SLIDER, RATE, DURATION = 1.0, 3.0 * math.pi / 50.0, 5.0  # [kg], [rad/s2] by half, [s]
PARTS, ELEMENTS, MODES = (2, 4), 10, 12


def angle(t: Tensor) -> Tensor:
    """Of the crank [rad]."""
    return RATE * t * t


def section() -> Any:
    """The square; polar inertia as the demo has it, and the shear area of a square."""
    inertia = SIDE**4 / 12.0
    return mbd.GivenSection.isotropic(
        E=E, nu=POISSON, density=DENSITY, area=SIDE**2, Iyy=inertia, Izz=inertia, J=2.0 * inertia
    )


def parts(modes: int = MODES, damping: float = DAMPING) -> mbd.System:
    """Six bodies; those of one beam are fixed to each other."""
    bodies, x = [], 0.0
    for name, length, count in (("crank", CRANK, PARTS[0]), ("rod", ROD, PARTS[1])):
        for k in range(count):
            line = mbd.BeamLine.straight(length / count, ELEMENTS)
            body = mbd.FlexibleBody.beam(
                f"{name}_{k}",
                line,
                section(),
                modes=modes,
                position=(x, 0.0, 0.0),
                reference="start",
                reduction="craig-bampton",
                interface=["end"],
                damping=damping,
            )
            bodies.append(body)
            x += length / count
    return _mechanism(bodies, PARTS[0])


def exact(elements: tuple[int, int] = (10, 20), damping: float = DAMPING) -> mbd.System:
    """Two beams."""
    crank = mbd.FlexibleBeam("crank", mbd.BeamLine.straight(CRANK, elements[0]), section(), damping=damping)
    line = mbd.BeamLine.straight(ROD, elements[1])
    rod = mbd.FlexibleBeam("rod", line, section(), position=(CRANK, 0.0, 0.0), damping=damping)
    return _mechanism([crank, rod], 1)


def _mechanism(bodies: list[Any], cranks: int) -> mbd.System:
    """Bodies one after another from the origin along x, the first `cranks` of them as the crank."""
    ground = mbd.Ground()
    slider = mbd.RigidBody("slider", SLIDER, (1.0, 1.0, 1.0), position=(CRANK + ROD, 0.0, 0.0))
    joints: list[Any] = [
        mbd.Revolute(ground.at(), bodies[0].at("start"), axis="z", name="shaft"),
        mbd.Drive(ground.at(), bodies[0].at("start"), axis="z", angle=angle, name="motor"),
    ]
    for k, (left, right) in enumerate(pairwise(bodies)):
        a, b = left.at("end"), right.at("start")
        joints.append(mbd.Revolute(a, b, axis="z") if k + 1 == cranks else mbd.Fixed(a, b))
    joints += [
        mbd.Spherical(bodies[-1].at("end"), slider.at()),
        mbd.Prismatic(ground.at(), slider.at(), axis="x"),
    ]
    return mbd.System([*bodies, slider], joints)


def deflection(places: Tensor) -> Tensor:
    """Signed distance of the middle from the chord [times] of start, middle, end of the rod [3, times, 3], in the plane [m]."""
    start, middle, end = places
    chord = end - start
    across = torch.linalg.cross(chord, middle - start)[:, 2]
    return across / chord.norm(dim=-1)


def observed(motion: mbd.Trajectory, rod: Sequence[tuple[str, str | None]]) -> tuple[Tensor, Tensor]:
    """Deflection of the rod's middle and place of the slider along x [times]."""
    places = torch.stack([motion.body(name).at(node).position[0] for name, node in rod])
    return deflection(places), motion.body("slider").r[0, :, 0]


IN_PARTS = (("rod_0", "start"), ("rod_2", "start"), ("rod_3", "end"))


def of_exact(elements: int) -> tuple[tuple[str, None], ...]:
    """Start, middle and end of an exact rod: its nodes are bodies."""
    return tuple((f"rod_{k}", None) for k in (0, elements // 2, elements))


def exudyn(steps: int, elements: tuple[int, int] = (20, 40)) -> tuple[Tensor, Tensor] | None:
    """The same of Exudyn's exact beams; None where it fails."""
    exu, items = load(), load(".itemInterface")
    mbs: Any = exu.SystemContainer().AddSystem()
    square = section()
    with torch.no_grad():
        K, M = square.stiffness(), square.mass()
    beams = [
        exact_beam(mbs, items, exu, Rod(K, M, count), start, length)
        for count, start, length in zip(elements, (0.0, CRANK), (CRANK, ROD), strict=True)
    ]
    shaft = mbs.AddNode(items.Node1D(referenceCoordinates=[0.0]))
    wheel = mbs.AddObject(items.ObjectRotationalMass1D(inertia=1.0, nodeNumber=shaft))
    still = mbs.AddNode(items.NodePointGround())
    turned = [mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=n, coordinate=0)) for n in (still, shaft)]

    def offset(_: Any, t: float, __: int, ___: float) -> float:
        return RATE * t * t

    mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=turned, offsetUserFunction=offset))
    at = [
        mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=wheel)),
        mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=beams[0][0])),
        mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=beams[0][-1])),
        mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=beams[1][0])),
    ]
    mbs.AddObject(items.ObjectJointGeneric(markerNumbers=at[:2], constrainedAxes=[1] * 6))
    mbs.AddObject(items.ObjectJointGeneric(markerNumbers=at[2:], constrainedAxes=[1, 1, 1, 1, 1, 0]))
    way = mbs.AddNode(items.Node1D(referenceCoordinates=[0.0]))
    slider = mbs.AddObject(items.ObjectMass1D(mass=SLIDER, nodeNumber=way, referencePosition=(CRANK + ROD, 0.0, 0.0)))
    ends = [
        mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=slider)),
        mbs.AddMarker(items.MarkerNodePosition(nodeNumber=beams[1][-1])),
    ]
    mbs.AddObject(items.ObjectJointSpherical(markerNumbers=ends))
    kind = exu.OutputVariableType.Position
    nodes = [beams[1][k] for k in (0, elements[1] // 2, -1)]
    sensors = [
        mbs.AddSensor(items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind)) for node in nodes
    ]
    with contextlib.redirect_stdout(sys.stderr):
        mbs.Assemble()
        if solve(exu, mbs, DURATION, steps, radius=0.6, absolute=1e-5, adaptive=True) is None:
            return None
    rows = np.stack([np.asarray(mbs.GetSensorStoredData(sensor)) for sensor in sensors])
    histories = torch.from_numpy(rows[:, :, 1:])
    t = np.linspace(0.0, DURATION, steps + 1)  # it halves its first step, so that its times are others
    both = (np.interp(t, rows[0, :, 0], x.numpy()) for x in (deflection(histories), histories[2, :, 0]))
    bent, way = map(torch.from_numpy, both)
    return bent, way


def main(steps: int = 1000) -> None:
    """Print deflections along the motion."""
    torch.set_num_threads(1)
    print(f"{'middle of the rod [mm] at':30}" + "".join(f"{f't = {t} s':>10}" for t in range(1, 6)) + f"{'slider':>12}")
    for name, system, rod in (
        ("parts", parts(), IN_PARTS),
        ("exact", exact(), of_exact(20)),
        ("exact, no damping", exact(damping=0.0), of_exact(20)),
    ):
        motion = mbd.simulate(system, DURATION, steps=steps, gradients="none").require_ok()
        _print(name, *observed(motion, rod))
    if available() and (other := exudyn(2 * steps)) is not None:
        _print("Exudyn, no damping", *other)


def _print(name: str, bent: Tensor, slider: Tensor) -> None:
    fifth = (len(bent) - 1) // 5
    rows = "".join(f"{1e3 * float(bent[fifth * t]):10.3f}" for t in range(1, 6))
    print(f"{name:30}{rows}{1e3 * float(slider[-1]):12.2f}", flush=True)


if __name__ == "__main__":
    main()
