"""The same mechanisms in Exudyn, a C++ multibody code: what experiments/benchmark/ compares with.

A flexible body is an ObjectFFRFreducedOrder whose mode shapes, reduced stiffness and nodal masses come from torchmbd's
structure stage. Exudyn has translations of nodes only: the rotary inertia of the nodes enters the modal mass (the modes
are normalized with it) and the inertia of the whole body, not the Coriolis terms.

Everything is chosen in Exudyn's favor: its fast binary (without range checks), one thread, a crank and a slider of one
coordinate each, dense or sparse linear solver, whichever is faster at this size, modified Newton, and only the time of
`SolveDynamic` is counted.
Needs the package `exudyn` (https://github.com/jgerstm/EXUDYN).
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor, nn
from torch.func import functional_call

import torchmbd as mbd
from experiments.models.panel import CORNERS, FORCE, FREE, LINKS, corners
from torchmbd.examples.slider_crank import CRANK, ROD, SLIDER_MASS, SPEED

# Flexible bodies of 8 modes from which on the sparse solver was the faster one, as measured.
SPARSE_FROM = 3


def load(part: str = "") -> Any:
    """The package, its fast binary, or a part of it (`.FEM`); its greeting goes to standard error."""
    sys.exudynFast = True  # type: ignore[attr-defined]  # what exudyn/__init__.py asks for
    with contextlib.redirect_stdout(sys.stderr):
        return importlib.import_module(f"exudyn{part}")


@dataclass(frozen=True)
class ReducedBody:
    """What a flexible body is to a multibody code; origin at its body frame, axes of the body.

    nodes [n, 3] m    mass [n] kg    rotary: of all nodes [kg m2]    modes [3 n, m]    stiffness [m, m]
    axes [3, 3]       body to ground at the start
    """

    nodes: np.ndarray
    mass: np.ndarray
    rotary: float
    modes: np.ndarray
    stiffness: np.ndarray
    axes: np.ndarray


class _Masses(nn.Module):
    def __init__(self, body: Any):
        super().__init__()
        self.body = body

    def forward(self) -> tuple[Tensor, Tensor]:
        _, mass, rotary, arm = self.body.assembly.masses()
        if arm is not None:
            raise mbd.InputError(
                ("masses", self.body.name), allowed="at its nodes", noun=f"masses of {self.body.name!r}"
            )
        return mass, rotary


def reduced(system: mbd.System, name: str, designs: Mapping[str, Tensor]) -> list[ReducedBody]:
    """The structure stage of one body for a batch of designs, parameter name -> [lanes, ...]."""
    body: Any = system.body(name)
    parameters = {key.replace(f"{name}.", "body.", 1): x for key, x in designs.items() if key.startswith(f"{name}.")}
    with torch.no_grad():
        stage = functional_call(system, dict(designs), (name,))
        mass, rotary = functional_call(_Masses(body), parameters, ())
    lanes = max([x.shape[0] for x in parameters.values()], default=1)

    def of(x: Tensor, rank: int, lane: int) -> np.ndarray:
        return (x if x.dim() == rank else x[lane]).numpy()

    nodes = (body.mesh.nodes - body.origin).numpy()
    modes = [of(stage["psi"], 3, i)[:, :3].reshape(3 * len(nodes), -1) for i in range(lanes)]
    return [
        ReducedBody(
            nodes,
            of(mass, 1, i),
            float(of(rotary, 1, i).sum()),
            modes[i],
            of(stage["Kr"], 2, i),
            body.axes.numpy(),
        )
        for i in range(lanes)
    ]


@dataclass(frozen=True)
class Run:
    """Strain energy U [times] of all flexible bodies at equal times t [s] (nan where Exudyn failed), the seconds that it
    integrated, and places [times, 3] of the nodes that were watched."""

    t: np.ndarray
    U: np.ndarray
    seconds: float
    places: tuple[np.ndarray, ...] = ()


class Model:
    """A mechanism under construction."""

    def __init__(self, gravity: float = 0.0):
        self.exu = load()
        self.mbs: Any = self.exu.SystemContainer().AddSystem()
        self.gravity = gravity
        self.energies: list[tuple[Any, np.ndarray]] = []
        self.watched: list[Any] = []
        self.ground = self._add("Ground")

    def _add(self, kind: str, **arguments: Any) -> Any:
        items = load(".itemInterface")

        return self.mbs.AddObject(getattr(items, f"Object{kind}")(**arguments))

    def _marker(self, kind: str, **arguments: Any) -> Any:
        items = load(".itemInterface")

        return self.mbs.AddMarker(getattr(items, f"Marker{kind}")(**arguments))

    def point(self, body: Any, position: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> Any:
        """Marker at a point of a rigid body."""
        return self._marker("BodyPosition", bodyNumber=body, localPosition=position)

    def node(self, body: Any, node: int) -> Any:
        """Marker at a mesh node of a flexible body."""
        return self._marker("SuperElementPosition", bodyNumber=body, meshNodeNumbers=[node], weightingFactors=[1.0])

    def spherical(self, a: Any, b: Any) -> None:
        """Let two markers coincide."""
        self._add("JointSpherical", markerNumbers=[a, b])

    def link(self, a: Any, b: Any, length: float) -> None:
        """Keep two markers at a distance."""
        self._add("ConnectorDistance", markerNumbers=[a, b], distance=length)

    def mass(self, mass: float, position: np.ndarray) -> Any:
        """A point mass under gravity."""
        items = load(".itemInterface")

        node = self.mbs.AddNode(items.NodePoint(referenceCoordinates=list(position)))
        number = self._add("MassPoint", mass=mass, nodeNumber=node)
        self.push(self.point(number), [0.0, -mass * self.gravity, 0.0])
        return number

    def spring(self, a: Any, b: Any, stiffness: float, damping: float, length: float) -> None:
        """Spring and damper along the line of two markers."""
        self._add(
            "ConnectorSpringDamper", markerNumbers=[a, b], stiffness=stiffness, damping=damping, referenceLength=length
        )

    def hold(self, marker: Any, place: np.ndarray, stiffness: float, damping: float) -> None:
        """Pull a marker to a place, in each of the ground axes."""
        numbers = {"stiffness": [stiffness] * 3, "damping": [damping] * 3}
        self._add("ConnectorCartesianSpringDamper", markerNumbers=[self.point(self.ground, place), marker], **numbers)

    def push(self, marker: Any, force: Sequence[float]) -> None:
        """A constant force in ground axes [N]."""
        self.mbs.AddLoad(load(".itemInterface").LoadForceVector(markerNumber=marker, loadVector=list(force)))

    def watch(self, body: Any, node: int) -> None:
        """Keep the places of a mesh node of a flexible body."""
        items = load(".itemInterface")

        kind = self.exu.OutputVariableType.Position
        sensor = items.SensorSuperElement(
            bodyNumber=body, meshNodeNumber=node, storeInternal=True, outputVariableType=kind
        )
        self.watched.append(self.mbs.AddSensor(sensor))

    def flexible(
        self,
        body: ReducedBody,
        position: np.ndarray,
        velocity: np.ndarray | None = None,
        angular_velocity: np.ndarray | None = None,
    ) -> Any:
        """Flexible body with its frame at a position, turned as at the start; rates in ground axes. Returns its number."""
        FEM = load(".FEM")
        items = load(".itemInterface")

        fem = FEM.FEMinterface()
        fem.nodes = {"Position": body.nodes}
        fem.massMatrix = scipy.sparse.diags_array(np.repeat(body.mass, 3)).tocsr()
        fem.stiffnessMatrix = scipy.sparse.eye_array(3 * len(body.nodes)).tocsr()  # replaced below
        fem.modeBasis = {"matrix": body.modes, "type": "NormalModes"}
        cms = FEM.ObjectFFRFreducedOrderInterface(fem)
        cms.stiffnessMatrixReduced = body.stiffness
        cms.massMatrixReduced = np.eye(len(body.stiffness))
        cms.inertiaLocal = cms.inertiaLocal + body.rotary * np.eye(3)
        numbers = cms.AddObjectFFRFreducedOrder(
            self.mbs,
            positionRef=position,
            initialVelocity=np.zeros(3) if velocity is None else velocity,
            rotationMatrixRef=body.axes,
            initialAngularVelocity=np.zeros(3) if angular_velocity is None else angular_velocity,
            gravity=[0.0, -self.gravity, 0.0],
        )
        kind = self.exu.OutputVariableType.Coordinates
        sensor = items.SensorNode(nodeNumber=numbers["nGenericODE2"], storeInternal=True, outputVariableType=kind)
        self.energies.append((self.mbs.AddSensor(sensor), body.stiffness))
        return numbers["oFFRFreducedOrder"]

    def _coordinate(self, velocity: float) -> Any:
        items = load(".itemInterface")

        return self.mbs.AddNode(
            items.Node1D(referenceCoordinates=[0.0], initialCoordinates=[0.0], initialVelocities=[velocity])
        )

    def crank(self, inertia: float, speed: float) -> Any:
        """Body that turns about z at a prescribed speed [rad/s]."""
        items = load(".itemInterface")

        angle = self._coordinate(speed)
        body = self._add("RotationalMass1D", inertia=inertia, nodeNumber=angle)
        still = self.mbs.AddNode(items.NodePointGround())
        markers = [self._marker("NodeCoordinate", nodeNumber=n, coordinate=0) for n in (still, angle)]
        self._add("ConnectorCoordinate", markerNumbers=markers, velocityLevel=True, offset=speed)
        return body

    def slider(self, mass: float, position: float) -> Any:
        """Body that slides along x."""
        return self._add("Mass1D", mass=mass, nodeNumber=self._coordinate(0.0), referencePosition=(position, 0.0, 0.0))

    def solve(self, duration: float, steps: int) -> Run:
        """Integrate with equal steps (generalized-alpha, spectral radius 0.9)."""
        self.mbs.Assemble()
        settings = self.exu.SimulationSettings()
        settings.parallel.numberOfThreads = 1
        kinds = self.exu.LinearSolverType
        sparse = len(self.energies) >= SPARSE_FROM
        settings.linearSolver.solverType = kinds.EigenSparse if sparse else kinds.EigenDense
        settings.solution.file.write = False
        settings.solution.sensors.writePeriod = duration / steps
        settings.timeIntegration.endTime = duration
        settings.timeIntegration.numberOfSteps = steps
        settings.timeIntegration.adaptiveStep = False
        settings.timeIntegration.newton.useModifiedNewton = True
        settings.timeIntegration.generalizedAlpha.spectralRadius = 0.9
        start = time.process_time()
        try:
            with contextlib.redirect_stdout(sys.stderr):
                self.mbs.SolveDynamic(settings, solverType=self.exu.DynamicSolverType.GeneralizedAlpha)
        except self.exu.SolverError:
            nothing = np.full(steps + 1, np.nan)
            return Run(np.linspace(0.0, duration, steps + 1), nothing, time.process_time() - start)
        seconds = time.process_time() - start
        histories = [(np.asarray(self.mbs.GetSensorStoredData(number)), K) for number, K in self.energies]
        U = sum(0.5 * np.einsum("ti,ij,tj->t", x[:, 1:], K, x[:, 1:]) for x, K in histories)
        places = tuple(np.asarray(self.mbs.GetSensorStoredData(number))[:, 1:] for number in self.watched)
        return Run(histories[0][0][:, 0], np.asarray(U), seconds, places)


def slider_crank(system: mbd.System, designs: Mapping[str, Tensor]) -> list[Callable[[float, int], Run]]:
    """Simulations (duration, steps) -> Run of a batch of designs of torchmbd/examples/slider_crank.py.

    The rod's second end is spherical as well, and its spin about its own axis free. Raises InputError where the system
    has another joint there.
    """
    for joint in system.joints:
        if isinstance(joint, mbd.Universal):
            raise mbd.InputError(("joints", joint.name), joint, "spherical", "build(..., joint='spherical')")
    rod: Any = system.body("rod")
    left, right = rod.mesh.node("left"), rod.mesh.node("right")

    def run(body: ReducedBody, duration: float, steps: int) -> Run:
        model = Model()
        # The crank starts along x: the rod's near end moves with its tip, its far end stands still.
        tip, turn = CRANK * SPEED, -CRANK * SPEED / ROD
        at = -body.axes @ body.nodes[left]
        link = model.flexible(
            body,
            at + np.array([CRANK, 0.0, 0.0]),
            np.array([0.0, tip + turn * at[0], 0.0]),
            np.array([0.0, 0.0, turn]),
        )
        model.spherical(model.point(model.crank(1e-4, SPEED), (CRANK, 0.0, 0.0)), model.node(link, left))
        model.spherical(model.point(model.slider(SLIDER_MASS, CRANK + ROD)), model.node(link, right))
        model.watch(link, right)
        return model.solve(duration, steps)

    return [lambda duration, steps, b=body: run(b, duration, steps) for body in reduced(system, "rod", designs)]


def chain(system: mbd.System, designs: Mapping[str, Tensor]) -> list[Callable[[float, int], Run]]:
    """The same for the pendulum chains of experiments/benchmark/cases.py."""
    names = [body.name for body in system.bodies]
    bodies = [reduced(system, name, designs) for name in names]
    lanes = max(len(lane) for lane in bodies)
    meshes = [system.body(name).mesh for name in names]
    gravity = 0.0 if system.gravity is None else float(system.gravity.norm())

    def run(links: list[ReducedBody], duration: float, steps: int) -> Run:
        model = Model(gravity)
        last, at = model.point(model.ground), np.zeros(3)
        for link, mesh in zip(links, meshes, strict=True):
            left, right = mesh.node("left"), mesh.node("right")
            number = model.flexible(link, at - link.axes @ link.nodes[left])
            model.spherical(last, model.node(number, left))
            last = model.node(number, right)
            at = at + link.axes @ (link.nodes[right] - link.nodes[left])
        return model.solve(duration, steps)

    each = [[lane[min(i, len(lane) - 1)] for lane in bodies] for i in range(lanes)]
    return [lambda duration, steps, links=links: run(links, duration, steps) for links in each]


def panel(system: mbd.System, designs: Mapping[str, Tensor]) -> list[Callable[[float, int], Run]]:
    """The same for the panel of experiments/models/panel.py."""
    body: Any = system.body("panel")
    places = [x.numpy() for x in corners(body)]
    ball, *ends = (body.mesh.node(corner) for corner in CORNERS)

    def run(reduced: ReducedBody, duration: float, steps: int) -> Run:
        model = Model()
        number = model.flexible(reduced, body.position.numpy())
        model.spherical(model.point(model.ground, places[0]), model.node(number, ball))
        for node, place, arm in zip(ends, places[1:], LINKS, strict=True):
            length = float(np.linalg.norm(arm))
            model.link(model.point(model.ground, place + np.array(arm)), model.node(number, node), length)
        free = body.mesh.node(FREE)
        model.push(model.node(number, free), FORCE)
        model.watch(number, free)
        return model.solve(duration, steps)

    return [lambda duration, steps, b=each: run(b, duration, steps) for each in reduced(system, "panel", designs)]


def available() -> bool:
    """Whether Exudyn is installed."""
    return importlib.util.find_spec("exudyn") is not None


def version() -> str:
    """Version of Exudyn."""
    return str(load().__version__)
