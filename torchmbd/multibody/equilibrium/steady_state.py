"""Whether a state that rotates as a whole is steady: the same to an observer who turns with it, at every angle.

    f(q o turn, t + angle / speed) = turn f(q, t),    Phi = 0        forces and joints, at `_ANGLES`
    Phi_q, N'K N, N'C N                                              directions of joints, stiffness and damping, after 1 rad

Supports of two stiffnesses have no force on their axis, whatever the turn: it is their stiffness that changes, and vibrations
then have coefficients that are periodic in time, not constant ones.
Checked in tests/multibody/equilibrium/test_steady_rotation.py.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchmbd.math.pair import dot
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Prescribed
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import SteadyRotation
from torchmbd.multibody.joints.primitive import Angle

_ANGLES = (
    32  # turns by 1 rad, 2 rad, ...: no two within 0.01 rad, no gap above 0.4 rad, so that contacts are met all around
)
_SAME = 1e-6  # of joints; of the stiffness and the damping of a freedom
_ROUNDING = 1e-13  # of the largest entry of stiffness, or of damping
_REMEDY = (
    "Try: supports that are alike across the axis; other supports of a rotor that is, with observer='ground'; or "
    "simulate(), which follows the motion in time"
)
_OTHERS = (
    "no steady rotation: joints or forces are others after a turn by {} rad. Try: gravity along the axis, and joints and "
    "drives to the ground that turn with the spin about its axis"
)


def unsteady(dynamics: Any, rest: Linearization, q: Tensor, t: Tensor, rotation: SteadyRotation, small: float) -> str:
    """Why the state q [n_q] at time t, linearized as `rest`, is not steady, else ""; small: size of works that count as none.

    Forces that move nothing count too: where they change, the loads of joints and the stiffness are unsteady.
    """
    T = dynamics.topology
    if not bool(rotation.spin.any()):
        return ""
    period, angles = _period(dynamics, t, rotation), range(1, _ANGLES + 1)
    turned = [rotation.turned(T, q[:, None, None])]
    while len(turned) < _ANGLES:
        turned.append(rotation.turned(T, turned[-1]))
    forces, phi = _loads(dynamics, torch.cat(turned, -1), t + period * t.new_tensor(angles), rotation)
    change = forces - torch.stack([rotation.turned_forces(T, rest.forces, k) for k in angles], -1)
    closed = (phi.abs() <= _SAME * rest.row_sizes[:, None]).all(0)
    same = ((rest.scale[:, None] * change).abs().amax(0) <= small) & closed
    if not bool(same.all()):
        return _OTHERS.format(1 + int(same.logical_not().nonzero()[0]))
    q_after = turned[0][:, 0, 0]
    if rotation.turning is not rotation:
        rest = Linearization.of(dynamics, q, t, observer=rotation)
    excitation = _prescribed(dynamics, turned[0], t + period, rotation)
    after = Linearization.of(dynamics, q_after, t + period, observer=rotation, excitation=excitation)
    return _changed_tangents(T, rest, after, rotation)


def _period(dynamics: Any, t: Tensor, rotation: SteadyRotation) -> float:
    """Time in which the drives turn by one radian [s]."""
    T, rate = dynamics.topology, float(rotation.spin.norm())
    if rotation.drives_follow:
        laws = zip(T.primitives, T.law_jets(t, dynamics.values().data), strict=True)
        angles = [law for kind, law in laws if isinstance(kind, Angle) and law]
        turns = [c.value * s.velocity - s.value * c.velocity for c, s in angles]
        rate = max((float(x.abs().max()) for x in turns), default=rate) or rate
    return 1.0 / rate


def _loads(dynamics: Any, q: Tensor, t: Tensor, rotation: SteadyRotation) -> tuple[Tensor, Tensor]:
    """Forces without those of joints [n_v, n], and violations of joints [rows, n], of states q [n_q, 1, n] at times t [n]."""
    T, data = dynamics.topology, dynamics.values().data
    at = equations.placement(T, data, q, _prescribed(dynamics, q, t, rotation))
    multipliers = q.new_zeros(T.rows, 1, q.shape[-1])
    forces = equations.dynamic_residual(T, data, at, *rotation.rates(T, q), multipliers)
    return forces[:, 0], equations.constraints(T, at)[:, 0] if T.rows else q.new_zeros(0, q.shape[-1])


def _prescribed(dynamics: Any, q: Tensor, t: Tensor, rotation: SteadyRotation) -> Prescribed:
    """What drives prescribe at q [n_q, 1, n] and times t [n] or t []: those between the ground and what turns follow the
    rotation if they do."""
    T, data = dynamics.topology, dynamics.values().data
    excitation = T.prescribed(t, data).values()
    if not rotation.drives_follow:
        return excitation
    at = equations.placement(T, data, q, excitation)
    on_ground = (T.vector_body == T.vector_body.new_tensor(T.bodies + len(T.prescribed_bodies)))[None, :, None, None]
    laws = list(excitation.laws)
    for i, (kind, vectors, held) in enumerate(zip(T.primitives, at.arguments, T.arguments(on_ground), strict=True)):
        law = laws[i]
        if isinstance(kind, Angle) and law is not None:
            x, y, b = vectors
            c, s = dot(x, b), dot(y, b)
            size, turns = (c * c + s * s).sqrt(), held[0][0] != held[2][0]
            laws[i] = tuple(torch.where(turns, part / size, old) for part, old in zip((c, s), law, strict=True))
    return excitation._replace(laws=laws)


def _changed_tangents(T: Any, rest: Linearization, after: Linearization, rotation: SteadyRotation) -> str:
    """What differs in the equations of small vibrations after a turn by 1 rad, else ""."""
    full = rest.forces.new_zeros(T.n_v, rest.N.shape[1])
    full[rest.active] = rest.N
    N = torch.stack([rotation.turned_increments(T, x) for x in full.T], 1) if full.shape[1] else full
    J = after.Phi_q / after.row_sizes[:, None]
    if after.N.shape[1] != N.shape[1] or float((J @ N).abs().amax() if N.numel() and len(J) else 0.0) > _SAME:
        return _OTHERS.format(1)
    if not N.shape[1]:
        return ""
    K, active = rest.reduced(rest.K), rest.active
    _, axes = torch.linalg.eigh(0.5 * (K + K.T))  # soft freedoms apart from stiff ones
    before, now = rest.N @ axes, N[active] @ axes
    # Damping first: at rest, dampers push what turns sideways, which is a stiffness.
    for name, x, y in (("damping", rest.C, after.C), ("stiffness", rest.K, after.K)):
        reference = before.T @ x[active][:, active] @ before
        difference = now.T @ y[active][:, active] @ now - reference
        size = reference.abs().amax(1) + _ROUNDING / _SAME * float(x.abs().max())
        share = difference.abs() / (size[:, None] * size).sqrt().clamp_min(1e-300)
        if float(share.max()) > _SAME:
            row = T.rate_name(int(active[int(before[:, int(share.amax(1).argmax())].abs().argmax())]))
            return f"no steady rotation: the {name} against {row} is another after a turn by 1 rad. {_REMEDY}"
    return ""
