"""The slider-crank of experiments/benchmark/beams.py in Exudyn: its geometrically exact beam, or its ANCF cable, as rod.

Everything is chosen in Exudyn's favor: its fast binary, one thread, a crank and a slider of one coordinate each, nodes with
Euler parameters, the sparse solver, modified Newton, a tolerance of 1e-6 (with its default of 1e-8 small steps fail). Only the
time of `SolveDynamic` is counted.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from experiments.peers.exudyn_peer import Run, load

CRANK, ROD, SLIDER, INERTIA, TORQUE = 0.15, 0.5, 0.1, 2e-3, 0.6  # [m], [m], [kg], [kg m2], [N m]


class Rod(NamedTuple):
    """Stiffness and mass per length of the section, axes x along the rod, y, z [6, 6]; number of elements."""

    stiffness: Tensor
    mass: Tensor
    elements: int

    @property
    def uncoupled(self) -> list[float]:
        """Stiffness of each strain where the other forces of the section vanish: Exudyn's beams take no couplings."""
        return (1.0 / torch.linalg.inv(self.stiffness).diagonal()).tolist()


def simulations(rod: Rod, observed: Callable[[Tensor], Tensor], cable: bool = False) -> Callable[[float, int], Run]:
    """Simulation (duration, steps) -> Run, whose U is `observed` of the places of start, middle and end [3, times, 3]."""
    return lambda duration, steps: _run(rod, observed, cable, duration, steps)


def _run(rod: Rod, observed: Callable[[Tensor], Tensor], cable: bool, duration: float, steps: int) -> Run:
    exu, items = load(), load(".itemInterface")
    mbs: Any = exu.SystemContainer().AddSystem()
    nodes = _cable(mbs, items, rod) if cable else exact_beam(mbs, items, exu, rod)
    angle = mbs.AddNode(items.Node1D(referenceCoordinates=[0.0]))
    crank = mbs.AddObject(items.ObjectRotationalMass1D(inertia=INERTIA, nodeNumber=angle))
    turned = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=angle, coordinate=0))
    mbs.AddLoad(items.LoadCoordinate(markerNumber=turned, load=TORQUE))
    if cable:
        pin = mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=crank, localPosition=[CRANK, 0.0, 0.0]))
        start = mbs.AddMarker(items.MarkerNodePosition(nodeNumber=nodes[0]))
        mbs.AddObject(items.ObjectJointSpherical(markerNumbers=[pin, start]))
    else:
        pin = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=crank, localPosition=[CRANK, 0.0, 0.0]))
        start = mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=nodes[0]))
        mbs.AddObject(items.ObjectJointGeneric(markerNumbers=[pin, start], constrainedAxes=[1, 1, 1, 1, 1, 0]))
    way = mbs.AddNode(items.Node1D(referenceCoordinates=[0.0]))
    slider = mbs.AddObject(items.ObjectMass1D(mass=SLIDER, nodeNumber=way, referencePosition=(CRANK + ROD, 0.0, 0.0)))
    ends = [
        mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=slider)),
        mbs.AddMarker(items.MarkerNodePosition(nodeNumber=nodes[-1])),
    ]
    mbs.AddObject(items.ObjectJointSpherical(markerNumbers=ends))
    kind = exu.OutputVariableType.Position
    sensors = [
        mbs.AddSensor(items.SensorNode(nodeNumber=nodes[k], storeInternal=True, outputVariableType=kind))
        for k in (0, len(nodes) // 2, -1)
    ]
    mbs.Assemble()
    seconds = solve(exu, mbs, duration, steps)
    if seconds is None:
        return Run(np.linspace(0.0, duration, steps + 1), np.full(steps + 1, np.nan), np.nan)
    samples = np.stack([np.asarray(mbs.GetSensorStoredData(sensor)) for sensor in sensors])
    return Run(samples[0, :, 0], observed(torch.from_numpy(samples[:, :, 1:])).numpy(), seconds)


def exact_beam(mbs: Any, items: Any, exu: Any, rod: Rod, start: float = CRANK, length: float = ROD) -> list[Any]:
    """Nodes of geometrically exact beams along x."""
    section = exu.BeamSection()
    section.stiffnessMatrix = np.diag(rod.uncoupled)
    section.massPerLength = float(rod.mass[0, 0])
    section.inertia = rod.mass[3:, 3:].numpy()
    places = np.linspace(start, start + length, rod.elements + 1).tolist()
    nodes = [mbs.AddNode(items.NodeRigidBodyEP(referenceCoordinates=[x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])) for x in places]
    for k in range(rod.elements):
        element = items.ObjectBeamGeometricallyExact(
            nodeNumbers=nodes[k : k + 2], length=length / rod.elements, sectionData=section
        )
        mbs.AddObject(element)
    return nodes


def _cable(mbs: Any, items: Any, rod: Rod) -> list[Any]:
    """Nodes of ANCF cables."""
    stretch, *_, bending = rod.uncoupled
    numbers = {"massPerLength": float(rod.mass[0, 0]), "axialStiffness": stretch, "bendingStiffness": bending}
    places = np.linspace(CRANK, CRANK + ROD, rod.elements + 1).tolist()
    nodes = [mbs.AddNode(items.NodePointSlope1(referenceCoordinates=[x, 0.0, 0.0, 1.0, 0.0, 0.0])) for x in places]
    for k in range(rod.elements):
        mbs.AddObject(items.ObjectANCFCable(nodeNumbers=nodes[k : k + 2], length=ROD / rod.elements, **numbers))
    return nodes


def solve(
    exu: Any,
    mbs: Any,
    duration: float,
    steps: int,
    radius: float = 0.9,
    absolute: float = 1e-7,
    adaptive: bool = False,
) -> float | None:
    """Seconds; None where it fails. radius: spectral; absolute: tolerance; adaptive: whether failed steps are halved."""
    settings = exu.SimulationSettings()
    settings.parallel.numberOfThreads = 1
    settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    settings.solution.file.write = False
    settings.solution.sensors.writePeriod = duration / steps
    settings.timeIntegration.endTime = duration
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.adaptiveStep = adaptive
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.timeIntegration.newton.relativeTolerance = 1e-6
    settings.timeIntegration.newton.absoluteTolerance = absolute
    settings.timeIntegration.generalizedAlpha.spectralRadius = radius
    start = time.process_time()
    try:
        with contextlib.redirect_stdout(sys.stderr):
            mbs.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
    except exu.SolverError:
        return None
    return time.process_time() - start
