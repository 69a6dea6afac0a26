"""Static equilibrium of an assembled mechanism, as a function of the design.

    f(q, b) + Phi_q' lam = 0,  Phi(q, t, b) = 0

    dq = -Phi_q^+ Phi + N z,   |N' K N| z = -N' (f + K dq_0)          |A|: symmetric part, eigenvalues taken positive

With positive eigenvalues every step goes downhill in energy, so a conservative mechanism ends at a stable equilibrium
and not at the nearest extremum (but one that starts exactly at an unstable one stays there, and says so). Steps are
limited in size. With beams the loads grow in steps (load_steps.py) where the start bears small ones. `unstable` takes the
eigenvalues as they are, for states that other forces than those of the stiffness hold: a shaft above its critical speed.

Derivatives by the design are those of one more step with the exact matrix, the implicit function theorem:

    dq/db = -(J^+ Phi_b + N (N' K N)^-1 N' (f_b + Phi_q,b' lam - K J^+ Phi_b))

Drives are held where they are at the time: their rates count for nothing. Where the whole rotates steadily (steady_rotation.py)
its inertia forces are loads, drives run, and what is found must balance after a turn by one radian as well.
Checked in tests/multibody/system/test_equilibrium.py, tests/sensitivity/test_rest.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.jet import Jet
from torchmbd.math.pair import cat, dot, linear, value
from torchmbd.multibody.joints.primitive import Angle
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.linearized import NEGATIVE_MASS, Linearization, Vibrations
from torchmbd.multibody.system.load_steps import LoadSteps
from torchmbd.multibody.system.steady_rotation import SteadyRotation

_STEPS, _LARGEST = 200, 0.3  # Newton steps; largest increment of a coordinate [m], [rad]
_FORCE, _CLOSED = 1e-10, 1e-11  # forces that remain, of the largest on the way; violation of a joint
_ROUNDING = 1e-14  # of stiffness times coordinates
_SAME = 1e-6  # of forces, and of joints, after a turn of a steady rotation
_UNSTEADY = (
    "no steady rotation: joints or forces are others after a turn by 1 rad; allowed: gravity along the axis, and joints and "
    "drives to the ground that turn with the spin about its axis"
)
_MIRRORED = (
    "no static equilibrium: a drive ends half a turn away from its angle; allowed: initial positions, or a time before, "
    "less than a quarter of a turn from it"
)
_SMALLER = "allowed: smaller loads, a start near another, unstable=True for one that its stiffness does not hold"
_NO_STIFFNESS = 1e-13  # of the largest eigenvalue of N' K N: rounding


@dataclass(frozen=True)
class Balance:
    """Where one design rests.

    q [n_q], lam [rows]   coordinates and least multipliers
    answer [n_v, n_v + rows]   increment of q that a residual (f, Phi) asks for, but for its sign
    missing   why there is no equilibrium, else ""; q is then where the search began
    doubt     what makes it none to start from: a freedom without stiffness, or an unstable one, else ""
    """

    q: Tensor
    lam: Tensor
    inverse: Tensor
    failure: str
    instability: str


def find_equilibria(
    dynamics: Any,
    q: Any,
    t: Tensor,
    follow: bool = False,
    rotation: SteadyRotation | None = None,
    unstable: bool = False,
) -> list[Balance]:
    """Where the lanes of a whole system rest at time t, near q [n_q, 1, lanes]; follow: each near where the one before does.

    unstable   the nearest equilibrium, whether it is stable or not
    """
    start, found = value(q).detach(), []
    with torch.no_grad():
        values = dynamics.values()
        for lane in range(dynamics.lanes):
            near = found[-1].q if follow and found else start[:, 0, min(lane, start.shape[-1] - 1)]
            found.append(_balanced(values.select_lanes([lane]), near, t, rotation, unstable))
    return found


def equilibrium_coordinates(
    dynamics: Any, found: list[Balance], t: Tensor, rotation: SteadyRotation | None = None
) -> Any:
    """Coordinates of rest [n_q, 1, lanes], with derivatives where the data have any and where there is an equilibrium."""
    T, data = dynamics.topology, dynamics.data
    at, lam = (torch.stack([getattr(x, name) for x in found], -1)[:, None] for name in ("q", "lam"))
    inverse = torch.stack([x.inverse for x in found])
    place = equations.placement(T, data, at, T.prescribed(t, data))
    still = at.new_zeros(T.n_v, 1, at.shape[-1])
    rates = (still, still) if rotation is None else rotation.rates(T, at)
    left = equations.dynamic_residual(T, data, place, *rates, lam)
    if T.rows:
        left = cat([left, equations.constraints(T, place)])

    def step(x: Tensor) -> Tensor:
        return -(inverse @ x.permute(2, 0, 1)).permute(1, 2, 0)

    return equations.advance(T, at, linear(step, left))


def reactions(dynamics: Any, q: Any, t: Tensor, rotation: SteadyRotation | None = None) -> Any:
    """Multipliers [rows, ...] at rest at q [n_q, ...] at time t, drives held; with derivatives as q and the data have."""
    T = dynamics.topology
    still = value(q).new_zeros(T.n_v, 1, value(q).shape[-1])

    def residual(data: equations.Data, at: equations.Placement, q: Any, x: Tensor) -> Any:
        drives, v = T.law_jets(t, data), still
        if rotation is None:
            drives = [drive and tuple(_held(jet) for jet in drive) for drive in drives]
        else:
            v, _ = rotation.rates(T, q)
        return equations.stabilized_residual(T, data, at, v, x[: T.n_v], x[T.n_v :], drives, 0.0)

    return dynamics.zero_left_out(dynamics.solve_linear(residual, t, q)[T.n_v :])


def _held(jet: Jet) -> Jet:
    """A law that stays where it is."""
    return Jet(jet.value, 0.0 * jet.velocity, 0.0 * jet.acceleration)


def vibrations(dynamics: Any) -> Vibrations:
    """Vibrations of one design about its initial position, as if it rested there."""
    with torch.no_grad():
        q, _ = dynamics.values().initial.solve(dynamics.values())
        return Vibrations.of(Linearization.of(dynamics.values(), q[:, 0, 0], q.new_zeros(())))


def _balanced(
    dynamics: Any, start: Tensor, t: Tensor, rotation: SteadyRotation | None = None, unstable: bool = False
) -> Balance:
    """Of one lane."""
    T, q = dynamics.topology, start
    steps = LoadSteps(dynamics, start, t, rotation) if T.beams is not None and not unstable else None
    if steps is not None and steps.stable:
        path = steps.run()
        if path.failure:
            return _none(T, start, f"no static equilibrium: {path.failure}; {_SMALLER}")
        q = path.q
    rest, largest = Linearization.of(dynamics, q, t, rotation=rotation), 0.0
    for _ in range(_STEPS):
        largest = max(largest, float(rest.forces.abs().max()))
        if _settled(rest, _FORCE * largest + _ROUNDING * _elastic(T, rest, q)):
            if _mirrored(T, dynamics.values().data, q, t):
                return _none(T, start, _MIRRORED)
            if rotation is not None and not _steady(dynamics, rest, q, t, rotation, largest):
                return _none(T, start, _UNSTEADY)
            if (
                rotation is not None and rest.negative_mass
            ):  # centrifugal forces are wrong there; at rest masses do not count
                return _none(T, start, f"no steady rotation: {NEGATIVE_MASS}; {_SMALLER}")
            return Balance(q, rest.lam, _answer(rest), "", _doubt(T, rest))
        if not bool(torch.isfinite(rest.forces).all()):
            break
        q = equations.advance(T, q[:, None, None], _step(rest, unstable)[:, None, None])[:, 0, 0]
        rest = Linearization.of(dynamics, q, t, rotation=rotation)
    left = rest.unbalanced.abs().nan_to_num(torch.inf)
    worst = int(rest.active[int(left.argmax())])
    missing = (
        f"no static equilibrium in {_STEPS} steps: {float(left.max()):.3g} N or N m remain on {_force(T, worst)}; "
        "allowed: a mechanism whose forces can balance, and initial positions near that"
    )
    return _none(T, start, missing)


def _mirrored(T: Any, data: equations.Data, q: Tensor, t: Tensor) -> bool:
    """Whether an axis stands opposite to its prescribed angle, which the constraint's row does not see."""
    at = equations.placement(T, data, q[:, None, None], T.prescribed(t, data))
    for kind, vectors, drive in zip(T.primitives, at.arguments, at.drives, strict=True):
        if isinstance(kind, Angle) and drive is not None:
            x, y, b = vectors
            c, s = drive
            if bool((dot(x, b) * c + dot(y, b) * s < 0.0).any()):
                return True
    return False


def _steady(dynamics: Any, rest: Linearization, q: Tensor, t: Tensor, rotation: SteadyRotation, largest: float) -> bool:
    """Whether joints and forces are the same after a turn by one radian.

    All forces, not only those that could move the mechanism: others load joints unsteadily, and change the stiffness.
    """
    T = dynamics.topology
    turned = rotation.turned(T, q[:, None, None])[:, 0, 0]
    after = Linearization.of(dynamics, turned, t + rotation.period, rotation=rotation)
    small = _SAME * largest + _ROUNDING * _elastic(T, rest, q)
    change = after.forces - rotation.turned_forces(T, rest.forces)
    return _settled(after, small, _SAME) and float(change.abs().max()) <= small


def _none(T: Any, start: Tensor, missing: str) -> Balance:
    nothing = start.new_zeros(T.n_v, T.n_v + T.rows)
    return Balance(start, start.new_zeros(T.rows), nothing, missing, "")


def _settled(rest: Linearization, small: float, gap: float = _CLOSED) -> bool:
    """Whether joints are closed and what remains is a small force."""
    closed = not rest.phi.numel() or float(rest.phi.abs().max()) < gap
    return closed and _largest(rest) <= small


def _elastic(T: Any, rest: Linearization, q: Tensor) -> float:
    """Size of the terms that cancel in elastic forces: stiffness times coordinates."""
    n = 3 * T.bodies
    size = torch.cat([q[:n], torch.ones_like(q[:n]), q[7 * T.bodies :]]).abs()
    return float((rest.K.abs() @ size).max())


def _largest(rest: Linearization) -> float:
    free = rest.N.T @ rest.unbalanced
    return float(free.abs().max()) if free.numel() else 0.0


def _step(rest: Linearization, unstable: bool) -> Tensor:
    """Increment [n_v] of Newton's method: downhill, or to the nearest equilibrium of any kind."""
    own, J = rest.active, rest.Phi_q[:, rest.active]
    close = -torch.linalg.pinv(J, rtol=1e-9) @ rest.phi
    forces = rest.N.T @ (rest.unbalanced + rest.K[own][:, own] @ close)
    if unstable:
        slide = -torch.linalg.pinv(rest.reduced(rest.K), rtol=_NO_STIFFNESS) @ forces
    else:
        values, vectors = _stiffness(rest)
        largest = float(values.abs().max()) if len(values) else 0.0
        slide = -vectors @ ((vectors.T @ forces) / values.abs().clamp_min(1e-9 * largest or 1.0))
    total = close + rest.N @ slide
    step = torch.zeros_like(rest.forces)
    step[own] = total * min(1.0, _LARGEST / max(float(total.abs().max()), 1e-300))
    return step


def _stiffness(rest: Linearization) -> tuple[Tensor, Tensor]:
    """Eigenvalues and vectors of the symmetric part of N' K N."""
    K = rest.reduced(rest.K)
    values, vectors = torch.linalg.eigh(0.5 * (K + K.T))
    return values, vectors


def _answer(rest: Linearization) -> Tensor:
    """Of `Balance`; freedoms without stiffness stay where they are."""
    own, n = rest.active, len(rest.forces)
    close = torch.linalg.pinv(rest.Phi_q[:, own], rtol=1e-9)
    K = rest.reduced(rest.K)
    inverse = K
    if len(K):
        values, _ = _stiffness(rest)
        free = bool(values.abs().min() <= _NO_STIFFNESS * values.abs().max())
        inverse = torch.linalg.pinv(K, rtol=_NO_STIFFNESS) if free else torch.linalg.inv(K)
    slide = rest.N @ inverse @ rest.N.T
    inverse = rest.forces.new_zeros(n, n + len(rest.phi))
    inverse[own[:, None], own] = slide
    inverse[own, n:] = close - slide @ rest.K[own][:, own] @ close
    return inverse


def _doubt(T: Any, rest: Linearization) -> str:
    """Of `Balance`."""
    values, vectors = _stiffness(rest)
    if not len(values) or float(values[0]) > _NO_STIFFNESS * float(values.abs().max()):
        return ""
    row = int(rest.active[int((rest.N @ vectors[:, 0]).abs().argmax())])
    if float(values[0]) < -_NO_STIFFNESS * float(values.abs().max()):
        return (
            f"the static equilibrium is unstable: {_freedom(T, row)} falls away from it; "
            "allowed: initial positions near a stable one, or start='assembled'"
        )
    return (
        f"the mechanism is free to move without a force: {_freedom(T, row)} has no static equilibrium of its own; "
        "allowed: a drive, a lock, a spring or a joint that holds it, or start='assembled'"
    )


def _force(T: Any, row: int) -> str:
    return _row(T, row, "force", "torque")


def _freedom(T: Any, row: int) -> str:
    return _row(T, row, "displacement", "rotation")


def _row(T: Any, row: int, straight: str, about: str) -> str:
    if row < 6 * T.bodies:
        kind = straight if row < 3 * T.bodies else about
        return f"{kind} {'xyz'[row // T.bodies % 3]} of {T.names[row % T.bodies]!r}"
    return f"a mode of {T.names[(row - 6 * T.bodies) % T.flexible]!r}"
