"""A switch from one phase to the next: marks of locks, the jump of the velocities, impacts.

    positions   continuous
    velocities  M (v+ - v-) + Phi_q' Lambda = 0,   Phi_q v+ = -Phi_t             momentum-consistent
    impact      M (v+ - v-) + Phi_q' Lambda + g_q' lam = 0,   g'+ = -e g'-       g: the gap, e: restitution (Newton)

with the constraints of the new phase. Numbers carry *total* derivatives with respect to the design: the time t* of the switch
moves with it.
Source: Nikravesh, Computer-Aided Analysis of Mechanical Systems, chapter 11; Pfeiffer and Glocker, Multibody Dynamics
with Unilateral Contacts, chapter 8.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.phases.events import Event, SubstituteSignals, Views, gap_gradient
from torchmbd.math.elementwise import reciprocal
from torchmbd.math.gradients import refuse_lost_gradients
from torchmbd.math.pair import Pair, cat, combine, dot, matvec, matvec_t, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import ATTACHED, Data
from torchmbd.multibody.equations.times_as_lanes import at_time
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.joints.lock import Lock
from torchmbd.multibody.saddle.condensation import Condensation
from torchmbd.multibody.start.initial import SharedStart
from torchmbd.multibody.system.dynamics import Dynamics, SaddleSolver
from torchmbd.results.state import State
from torchmbd.results.trajectory import Trajectory

_BESIDE = 1e-6  # of a step: from a switch to both sides of it
_JUMP = 1e-4  # of the largest rate or acceleration: less is lost in what steps leave


@dataclass(frozen=True, eq=False)
class InitialState:
    """Initial coordinates of a simulation of phases, where the rank of the constraints of each phase is found.

    size     of the mechanism as it was built [m]
    shared   the start that other designs have as well, with the ranks that were found there; None: it is that of this design
    """

    q: Tensor
    v: Tensor
    size: float
    shared: SharedStart | None
    condensed: Condensation | None = None

    def shared_start(self, dynamics: Dynamics) -> SharedStart | None:
        """`shared`."""
        return self.shared

    def solve(self, dynamics: Dynamics) -> tuple[Any, Any]:
        """q [n_q, 1, 1] and v [n_v, 1, 1], of the first lane."""
        return self.q, self.v


def data_with_marks(T: Topology, data: Data, q: Any, locks: Sequence[Lock]) -> Data:
    """The data with the marks of locks as the coordinates q [n_q, ...] have them: points and axes that a lock holds."""
    if not locks:
        return data
    index = {id(attached): i for i, attached in enumerate(T.attached)}
    at = equations.placement(T, data, q, T.prescribed(value(q).new_zeros(()), data))
    for lock in locks:
        m = lock.marks
        point_a, point_b, point = (index[id(x)] for x in (m.point_a, m.point_b, m.point))
        axes_a, axes_b, axes = ([index[id(x)] for x in triad] for triad in (m.axes_a, m.axes_b, m.axes))
        offset = matvec_t(at.A_of[:, :, point_a], at.g[:, point_b] - at.g[:, point_a])
        data = _set_vector(data, T, point, axes_a, _solve(at.rho[:, axes_a], offset), point_a)
        A, B = at.A_of[:, :, point_b], at.rho[:, axes_b]
        for j, axis in enumerate(axes):
            e, other = at.g[:, axes_a[j]], at.g[:, axes_a[(j + 2) % 3]]
            # On a bent body axes are not quite perpendicular; those of the equation of a mark are.
            if axes_a[j] < T.attached_flexible:
                e = combine(e, -dot(e, other) * reciprocal(dot(other, other)), other)
            data = _set_vector(data, T, axis, axes_b, _solve(B, matvec_t(A, e)), None)
    return data


def _solve(B: Any, y: Any) -> Any:
    """B^-1 y of numbers [3, 3, ...] and [3, ...]; nan where B is singular, as in a lane that has diverged."""

    def times(x: Tensor) -> Tensor:
        solution, info = torch.linalg.solve_ex(value(B)[:, :, 0].movedim(-1, 0), x.permute(2, 0, 1))
        return torch.where(info[:, None, None] == 0, solution, torch.nan).permute(1, 2, 0)

    x = times(value(y))
    if not isinstance(y, Pair):
        return x
    return Pair.of(x, times((y - matvec(B, x)).tangent))


def _set_vector(data: Data, T: Topology, index: int, axes: list[int], c: Any, origin: int | None) -> Data:
    """Set an attached vector to c_1 axes_1 + c_2 axes_2 + c_3 axes_3, from the vector `origin` if there is one."""
    data = dict(data)
    for name, axis in ATTACHED.items():
        if name not in data or (name != "x" and index >= T.attached_flexible):
            continue
        x = data[name]
        before = (slice(None),) * axis
        vectors = x[(*before, axes)]
        vector = (vectors * c).sum(axis)
        if origin is not None:
            vector = vector + x[(*before, origin)]
        parts = [x[(*before, slice(0, index))], vector.unsqueeze(axis), x[(*before, slice(index + 1, None))]]
        data[name] = cat(parts, axis)
    return data


def entered(dynamics: Dynamics, t: Tensor, q: Any, v: Any) -> tuple:
    """Velocities [n_v, ...] after the constraints begin to act on bodies that move with v, accelerations, and multipliers."""
    solver = SaddleSolver(dynamics, t, q)
    (v,) = jump(dynamics, t, q, v, solver)
    return v, *dynamics.accelerations(t, q, v, solver)


def laws_jump(dynamics: Dynamics, t: Tensor, h: float, x: State) -> Tensor:
    """Return True for lanes whose time-dependent drives or forces jump at times t [1, lanes]; x: a state without tangents.

    h   size of a regular step [s]
    """
    before, after = (entered(dynamics, t[0] + sign * _BESIDE * h, x.q, x.v)[:2] for sign in (-1.0, 1.0))
    jumps = torch.zeros_like(t[0], dtype=torch.bool)
    for a, b in zip(before, after, strict=True):
        jumps |= ((a - b).abs() > _JUMP * a.abs().maximum(b.abs()).amax(0)).flatten(0, 1).any(0)
    return jumps


def jump(dynamics: Dynamics, t: Tensor, q: Any, v: Any, solver: SaddleSolver | None = None) -> tuple:
    """Velocities v+ [n_v, ...] after the constraints begin to act on bodies that move with v."""
    if not dynamics.topology.rows:
        return (v,)
    return (v + _velocity_change(solver or SaddleSolver(dynamics, t, q), dynamics, t, None, v),)


def _velocity_change(solver: SaddleSolver, dynamics: Dynamics, t: Tensor, impulse: Any, v: Any) -> Any:
    """Change of the velocities [n_v, ...] under an applied impulse [n_v, ...] so that v plus the change fits.

    M dv + Phi_q' Lambda = impulse,   Phi_q (v + dv) = -Phi_t; without v: Phi_q dv = 0.
    """
    T = dynamics.topology

    def residual(data: Data, at: equations.Placement, q: Any, impulse: Any, v: Any, x: Tensor) -> Any:
        dv, Lam = x[: T.n_v], x[T.n_v :]
        forces = equations.impulses(T, data, at, dv, Lam)
        forces = forces if impulse is None else forces - impulse
        if not T.rows:
            return forces
        if v is None:
            return cat([forces, equations.constraint_changes(T, at, data, dv)])
        return cat([forces, equations.constraint_rates(T, at, data, v + dv, t)])

    return solver(residual, impulse, v)[: T.n_v]


def restitution(dynamics: Dynamics, t: Tensor, q: Any, v: Any, gap: tuple[Any, Any], e: float) -> tuple:
    """Velocities after an impact at a gap g, of the gradient (g_q [n_v, ...], g_t [1, ...])."""
    g_q, g_t = gap
    response = _velocity_change(SaddleSolver(dynamics, t, q), dynamics, t, g_q, None)
    rate = (g_q * v).sum(0).unsqueeze(0) + g_t
    size = (-(1.0 + e)) * rate * reciprocal((g_q * response).sum(0).unsqueeze(0))
    return (v + response * size,)


def _velocities(impact: Callable, motion: Trajectory) -> Tensor:
    """Velocities [lanes, times, n_v] by a user's map, to which multipliers are nan: during an impact there are impulses.

    InputError if it returns anything else.
    """
    unknown = motion.q.new_full((motion.lanes, motion.signals.times, motion.dynamics.topology.rows), torch.nan)
    before = replace(motion, signals=SubstituteSignals(motion.signals, {"lam": unknown}))
    v, shape = impact(before), tuple(motion.v.shape)
    if not isinstance(v, Tensor) or v.shape != shape:
        returned = f"shape {tuple(v.shape)}" if isinstance(v, Tensor) else repr(v)
        raise InputError(
            ("phases", "impact"),
            allowed=f"must return a tensor [lanes, times, n_v], {shape}",
            state=f"returned {returned}",
            noun="the impact of a phase",
        )
    return v


def velocities_after_impact(
    impact: float | Callable, event: Event, views: Views, lanes: Sequence[int], dynamics: Dynamics, t: Any, x: State
) -> Any:
    """Velocities [n_v, ...] of lanes after the impact that ends a phase: a restitution, or a map motion -> v."""
    if callable(impact):

        def after(motion: Trajectory) -> Tensor:
            return _velocities(impact, motion)[:, 0].T

        if not torch.is_grad_enabled():  # else the adjoint goes again through a motion whose impacts were checked
            with torch.enable_grad():
                plain = views.evaluate(after, lanes, dynamics.values(), value(t), x.values())
            refuse_lost_gradients(("phases", "impact"), plain, "constant tensors", views.whole.designs.values())
        return views.evaluate(after, lanes, dynamics, t, x)
    g_q, g_t = gap_gradient(event, views, lanes, dynamics, t, x)

    def rebound(dynamics: Dynamics, t: Tensor, q: Any, v: Any, g_q: Any, g_t: Any) -> tuple:
        return restitution(dynamics, t, q, v, (g_q, g_t), impact)

    return at_time(rebound, dynamics, t, x.q, x.v, g_q, g_t)[0]
