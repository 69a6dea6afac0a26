"""The linearized system as matrices for control: x' = A x + B u, y = C x + D u.

    x = (z, z')        q = q0 o N z: independent increments of the coordinates, N the null space of the constraints
    A = [0, 1; -m^-1 N'K N, -m^-1 N'C N],  m = N'M N        B = [0; m^-1 N'F]        C = [dy/dq N, dy/dq' N],  D = 0

F: generalized forces of unit inputs. Inputs are the actuators and outputs the signals of controllers (mbd.signals).
About a state of a motion z are independent coordinates, and N moves (moving_state.py); A(t) at one time is frozen: x' = A(t) x.
Numbers, without derivatives: frequencies, poles and measures of them have these.
Checked in tests/extensions/vibrations/test_linear_system.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.signal
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchmbd.errors import InputError, SimulationFailure
from torchmbd.extensions.vibrations.moving_state import MovingLinearization, time_index
from torchmbd.extensions.vibrations.port_functions import PORTS, PortFunctions, Ports
from torchmbd.math.checked_numbers import is_whole, list_of, reals
from torchmbd.multibody.equilibrium.equilibrium import SPIN
from torchmbd.multibody.equilibrium.linearized import Linearization, factored_inertia
from torchmbd.multibody.equilibrium.steady_rotation import Observer, ObserverAtRest
from torchmbd.multibody.forces.controller import Controller
from torchmbd.multibody.forces.signals import Actuator, Signal, Time
from torchmbd.multibody.system import System
from torchmbd.results.motion_data import has_failed
from torchmbd.results.trajectory import Trajectory
from torchmbd.simulation.equilibrium import Equilibrium, equilibrium

# Of works of forces and stiffness by increments of the sizes of the coordinates, and violation of joints as a share of these.
_BALANCED = 1e-6  # far above those of an equilibrium
_ROUNDED = 1e-9  # share of a part of a freedom: parts that differ by rounding
# Of a motion, all in increments of the coordinates as shares of their sizes: violation of joints, and of their rates as a
# share of the largest rate of the motion; accelerations that steps may be off, as a share of those of the state and of the
# largest of the motion. A rate or an acceleration counts if it moves the
# mechanism by more than _STILL, a share of its size, within the duration of the motion.
_KEPT, _SAME, _STILL = 1e-3, 0.05, 1e-4
_UNIT = 1.0 - 1e-9  # entry of an increment from which on it is said to be that of one coordinate


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """x' = A x + B u, y = C x + D u about a state; arrays of NumPy, as scipy.signal and `control.ss` take them.

    states, inputs, outputs   their names
    shapes                    increments of the coordinates for unit values of the first half of the states [n_v, n]

    >>> [hinge] = mbd.examples.pendulum(length=2.0).joints
    >>> system = mbd.System([hinge.b.body], [hinge], gravity=(0.0, -9.81, 0.0))
    >>> linear = mbd.vibrations.linearize(system, [mbd.signals.JointTorque(hinge)], [mbd.signals.JointRate(hinge)])
    >>> linear.response(0.1).shape, linear.to_scipy().D.shape  # one frequency, output and input
    ((1, 1, 1), (1, 1))
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: list[str]
    inputs: list[str]
    outputs: list[str]
    shapes: np.ndarray

    def to_scipy(self) -> scipy.signal.StateSpace:
        """For the functions of scipy.signal."""
        return scipy.signal.StateSpace(self.A, self.B, self.C, self.D)

    def response(self, frequencies: ArrayLike) -> np.ndarray:
        """Frequency response [frequencies, outputs, inputs], complex, at frequencies [Hz]."""
        f = np.atleast_1d(reals("frequencies", frequencies).numpy())
        if f.ndim != 1 or not np.isfinite(f).all():
            raise InputError("frequencies", frequencies, "finite numbers [Hz]")
        unit, result = np.eye(len(self.A)), []
        for x in f:
            try:
                result.append(self.C @ np.linalg.solve(2j * np.pi * x * unit - self.A, self.B) + self.D)
            except np.linalg.LinAlgError as error:
                raise InputError(
                    "frequencies",
                    frequencies,
                    "other frequencies",
                    state=f"contains {x:g} Hz, the frequency of an undamped pole, where the response is infinite",
                ) from error
        return np.stack(result) if result else np.zeros((0, *self.D.shape), dtype=complex)


def linearize(
    system: System,
    inputs: Sequence[Actuator],
    outputs: Sequence[Signal],
    state: Trajectory | None = None,
    lane: int = 0,
    time: float | None = None,
    coordinates: Sequence[str] | None = None,
) -> LinearSystem:
    """Linearize a system about a state: matrices A, B, C, D with names.

    inputs    actuators, such as mbd.signals.JointTorque(joint); outputs: signals, such as mbd.signals.JointAngle(joint)
    state     an equilibrium, a steady rotation, or a motion of the system; None: the equilibrium near the initial position
    lane      which design of the state
    time      one of the times of the state [s]; None: the last one
    coordinates   for a motion: names of independent increments, such as "rotation z of 'bob'", as in `states`; None:
                  independent modes and rotations first, then displacements

    Controllers of the system stay closed. About a motion x are the increments of the coordinates and their rates:
    displacements in ground axes, rotations in axes of the moving body. x' = A(t) x holds along the motion for any coordinates,
    but the eigenvalues of A at one time depend on them, if their relation turns with the motion; `states` has their names.
    Entries of A are sums of springs, in which soft ones lose digits: with a spring of 1e10 times its stiffness, a frequency
    has an error of 1e-6, which frequencies and poles of an equilibrium do not have.
    Raises InputError for another kind of state, for a motion in phases, and for inputs and outputs whose direction rotates
    for the observer of a steady rotation: directions of the ground perpendicular to the axis need observer="ground".
    SimulationFailure for a lane that failed.

    >>> [hinge] = mbd.examples.pendulum(length=2.0).joints
    >>> bob = hinge.b.body
    >>> system = mbd.System([bob], [hinge], gravity=(0.0, -9.81, 0.0))
    >>> linear = mbd.vibrations.linearize(system, [mbd.signals.JointTorque(hinge)], [mbd.signals.JointAngle(hinge)])
    >>> linear.A.round(3).tolist(), linear.inputs, linear.outputs
    ([[0.0, 1.0], [-4.905, 0.0]], ['JointTorque 1'], ['JointAngle 1'])
    """
    if not isinstance(system, System):
        raise InputError("system", system, "a System")
    inputs, outputs = checked_ports(inputs, outputs)
    state = equilibrium(system) if state is None else state
    if not isinstance(state, Trajectory):
        raise InputError("state", state, "a motion, or an equilibrium or steady rotation of mbd.equilibrium")
    if not is_whole(lane) or not 0 <= lane < state.lanes:
        raise InputError("lane", lane, f"0 to {state.lanes - 1}")
    if has_failed(state.status[lane]):
        raise SimulationFailure(f"lane {lane}: {state.status[lane]}")
    ports = Ports(len(inputs))
    with torch.no_grad():
        dynamics, links = _with_ports(system, ports, inputs, outputs, state, lane)
        k = time_index(state, time)
        q = state.q[lane, k].detach()[:, None, None]
        if q.shape[0] != dynamics.topology.n_q:
            raise InputError(
                "state",
                list(q.shape[:1]),
                f"must have {dynamics.topology.n_q}, those of the system",
                state=f"has {q.shape[0]} coordinates",
            )
        if isinstance(state, Equilibrium):
            if coordinates is not None:
                raise InputError(
                    "coordinates",
                    coordinates,
                    "given with a motion alone",
                    state=f"is {coordinates!r} with an equilibrium",
                )
            small = _about_rest(dynamics, q, state, lane, k)
        else:
            small = _about_motion(dynamics, q, state, lane, k, coordinates)
        return _matrices(dynamics, ports, links, q, state.t[k].detach(), small, _names(inputs), _names(outputs))


def _with_ports(system: System, ports: Ports, inputs: list, outputs: list, state: Trajectory, lane: int) -> tuple:
    """The equations of one design of the system with inputs and outputs, and their link."""
    with_ports = system_with_ports(system, ports, inputs, outputs)
    dynamics, _ = with_ports.stages({name: x[lane : lane + 1].detach() for name, x in state.designs.items()})
    return dynamics.values(), link_of_ports(dynamics)


def checked_ports(inputs: Any, outputs: Any) -> tuple[list[Actuator], list[Signal]]:
    """Actuators and signals; InputError for anything else, and for none."""
    inputs = list_of("inputs", inputs, Actuator, "actuators, such as mbd.signals.JointTorque(joint)")
    outputs = list_of("outputs", outputs, Signal, "signals, such as mbd.signals.JointAngle(joint)")
    if not inputs:
        raise InputError("inputs", inputs, "must contain at least one actuator", state="is empty")
    if not outputs:
        raise InputError("outputs", outputs, "must contain at least one signal", state="is empty")
    if any(isinstance(signal, Time) for signal in outputs):
        raise InputError("outputs", outputs, "signals of the motion", state="contains mbd.signals.Time()")
    return inputs, outputs


def system_with_ports(system: System, ports: Ports, inputs: Sequence[Actuator], outputs: Sequence[Signal]) -> System:
    """The system with actuators that `ports` sets and signals that `link_of_ports` reads."""
    probe = Controller(ports, outputs, inputs, name=PORTS)
    nodes = {id(node) for beam in system.beams for node in beam.node_bodies}
    names = [body.name for body in (*system.bodies, *system.beams) if id(body) not in nodes]
    return System(system.bodies, system.joints, [*system.forces, probe], system.gravity, free=names)


def link_of_ports(dynamics: Any) -> Any:
    """The link of a system with ports."""
    return next(link for link in dynamics.topology.links.each if link.control.name == PORTS)


class _Coefficients(NamedTuple):
    """M z'' + C z' + K z = forces, x = N z, x' = N z' + N1 z as an observer measures x; names of z."""

    M: Tensor
    C: Tensor
    K: Tensor
    N: Tensor
    N1: Tensor
    observer: Observer
    names: list[str]


def _about_rest(dynamics: Any, q: Tensor, state: Equilibrium, lane: int, k: int) -> _Coefficients:
    observer: Observer = ObserverAtRest()
    if state.rotation is not None:
        observer = state.rotation.of_spin(state.dynamics.values().select_lanes([lane]).data[SPIN].detach())
    rest = Linearization.of(dynamics, q[:, 0, 0], state.t[k].detach(), None, observer)
    stiffness = rest.scale[:, None] * rest.K * rest.scale
    size = max(float(rest.works.abs().max()), float(stiffness.abs().max()))
    if not float((rest.N.T @ rest.unbalanced).abs().amax(0) if rest.N.numel() else 0.0) <= _BALANCED * size or not bool(
        (rest.phi.abs() <= _BALANCED * rest.row_sizes).all()
    ):
        raise InputError(
            "state", state, "mbd.equilibrium(...) of this system", state="is not an equilibrium of the system"
        )
    factored_inertia(rest.inertia)
    # Each freedom moves its largest coordinate by one, so that it has the unit of this coordinate.
    parts = rest.N / rest.scale[rest.active, None]
    near_largest = parts.abs() >= (1.0 - _ROUNDED) * parts.abs().amax(0, keepdim=True)
    largest = near_largest.int().argmax(0)  # the first of equal ones
    rest = replace(rest, N=rest.N / rest.N.gather(0, largest[None]).abs())
    N = torch.zeros(len(rest.forces), rest.N.shape[1], dtype=q.dtype)
    N[rest.active] = rest.N
    C, names = rest.reduced(rest.C), _freedoms(dynamics.topology, parts, rest.active[largest])
    return _Coefficients(rest.inertia, C, rest.stiffness, N, torch.zeros_like(N), observer, names)


def _about_motion(
    dynamics: Any, q: Tensor, state: Trajectory, lane: int, k: int, coordinates: Sequence[str] | None
) -> _Coefficients:
    v, a = (x[lane, k].detach() for x in (state.v, state.a))
    moving = MovingLinearization.of(dynamics, q, v[:, None, None], state.t[k].detach(), coordinates)
    speed, fastest = (float((x[lane].detach() / moving.scale).abs().nan_to_num().max()) for x in (state.v, state.a))
    duration, opening = float(state.t[-1] - state.t[0]), moving.violation
    change = float(((moving.observer.a[:, 0, 0] - a) / moving.scale).abs().max())
    near = _SAME * float((a / moving.scale).abs().max()) + _KEPT * fastest + _STILL / duration**2
    if not (opening[0] <= _KEPT and opening[1] <= _KEPT * speed + _STILL / duration and change <= near):
        raise InputError(
            "state",
            state,
            "mbd.simulate(...) of this system, with small steps",
            state=f"is not a motion of the system: its joints are open by {opening[0]:.2g} of the size of the mechanism and "
            f"part at {opening[1]:.2g} of the size per second, and its accelerations are off by {change:.2g} of the size per "
            f"second squared, where at most {near:.2g} is accepted",
        )
    names = [dynamics.topology.rate_name(row) for row in moving.rows]
    factored_inertia(moving.M)  # refuses what moves without a mass
    return _Coefficients(moving.M, moving.C, moving.K, moving.N, moving.N1, moving.observer, names)


def _matrices(
    dynamics: Any,
    ports: Ports,
    link: Any,
    q: Tensor,
    t: Tensor,
    small: _Coefficients,
    inputs: list[str],
    outputs: list[str],
) -> LinearSystem:
    T, data = dynamics.topology, dynamics.data
    N, observer, n = small.N, small.observer, small.N.shape[1]
    functions, still = PortFunctions(T, t, ports, link.read), torch.zeros_like(N)

    def signals(x: Tensor, xd: Tensor) -> Tensor:
        return functions.outputs(q, data, observer, x[..., None], xd[..., None])[..., 0]

    functions.require_steady(q, data, observer)
    unit = torch.stack([functions.forces(q, data, observer, k)[:, 0, 0] for k in range(len(ports.u))], 1)
    A, B = q.new_zeros(2 * n, 2 * n), q.new_zeros(2 * n, len(ports.u))
    A[:n, n:] = torch.eye(n, dtype=q.dtype)
    A[n:, :n], A[n:, n:] = (0.0 - torch.linalg.solve(small.M, x) for x in (small.K, small.C))
    B[n:] = torch.linalg.solve(small.M, N.T @ unit)
    C = torch.cat([signals(N, small.N1), signals(still, N)], 1)
    D = np.zeros((len(C), len(ports.u)))
    states = [*small.names, *(f"rate of {name}" for name in small.names)]
    return LinearSystem(A.numpy(), B.numpy(), C.numpy(), D, states, inputs, outputs, N.numpy())


def _freedoms(T: Any, parts: Tensor, rows: Tensor) -> list[str]:
    """Names of freedoms: of one coordinate, or of the one that moves most.

    parts   increments of the coordinates divided by their sizes [active, n];  rows: of v, those that move most [n]
    """
    single = (parts.abs().amax(0) > _UNIT * parts.norm(dim=0)).tolist()
    names = [T.rate_name(row) for row in rows.tolist()]
    return [
        name if alone else f"freedom {k}, most {name}"
        for k, (name, alone) in enumerate(zip(names, single, strict=True), 1)
    ]


def _names(ports: Sequence[Any]) -> list[str]:
    """A name for each number: its kind, the place in the list, and the axis of vectors."""
    names = []
    for k, port in enumerate(ports, 1):
        name, size = f"{type(port).__name__} {k}", getattr(port, "size", 1)
        names += [name] if size == 1 else [f"{name} {axis}" for axis in "xyz"[:size]]
    return names
