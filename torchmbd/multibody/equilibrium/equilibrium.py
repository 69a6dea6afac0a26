"""Static equilibrium of an assembled mechanism, as a function of the design.

    f(q, b) + Phi_q' lam = 0,  Phi(q, t, b) = 0

    dq = -Phi_q^+ Phi + N z,   |N' K N| z = -N' (f + K dq_0)          |A|: symmetric part, eigenvalues taken positive

With positive eigenvalues every step decreases the energy, so a conservative mechanism ends at a stable equilibrium and not at
the nearest extremum; only a start exactly at an unstable equilibrium stays there, and is reported. Steps are limited by the
size of the mechanism, and forces are compared as works on coordinates of this size (coordinate_scale.py).
With beams the loads grow in steps (load_steps.py) where the start is stable under small loads. `unstable=True` leaves the signs
of the eigenvalues, for states that are stable by other forces than those of the stiffness: a shaft above its critical speed.

Derivatives with respect to the design are those of more steps with the exact matrix, the implicit function theorem:

    dq/db = -(J^+ Phi_b + N (N' K N)^-1 N' (f_b + Phi_q,b' lam - K J^+ Phi_b))

Drives are fixed at their value at time t; their rates do not matter. In a steady rotation of the whole system
(steady_rotation.py) inertia forces are loads, drives run, and the state must be the same at every turn (steady_state.py).
Checked in tests/multibody/equilibrium/test_equilibrium.py, tests/sensitivity/test_rest.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.jet import Jet
from torchmbd.math.pair import apply, cat, dot, linear, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equilibrium.linearized import NEGATIVE_MASS, Linearization, Vibrations
from torchmbd.multibody.equilibrium.load_steps import LoadSteps
from torchmbd.multibody.equilibrium.steady_rotation import SteadyRotation
from torchmbd.multibody.equilibrium.steady_state import unsteady
from torchmbd.multibody.joints.primitive import Angle

_STEPS = 200  # Newton steps
_LARGEST = 0.3  # largest increment of a coordinate, as a share of its size; of a rotation [rad]
_FAR = 1e6  # times its size at the start, to which a mechanism may grow: beyond that a soft spring does not hold it
_SWEEP_STEPS = 8  # of all speeds together; those that need more are searched one after the other
_NEAR = 0.1  # of the distance between the equilibria of neighboring speeds, that a first step between them may miss
_FORCE = 1e-10  # largest unbalanced force, as a share of the largest force of all steps, both as works
_CLOSED = 1e-11  # violation of a joint, as a share of the size of its row
_ROUNDING = 1e-14  # of the terms that cancel in forces
_LOADED = (
    1e-15  # of the same: what loads a freedom without stiffness, so that its stiffness is below the rounding of others
)
SPIN = "spin"  # name of the angular velocity [3, 1, lanes] of a steady rotation among the data
_SAME = 1e-6  # of the largest force: a change of forces in a steady rotation that counts as none
_MIRRORED = (
    "no static equilibrium: a drive ends half a turn away from its angle. Try: initial positions, or a time before, "
    "less than a quarter of a turn from it"
)
_SMALLER = "Try: smaller loads, a start near another, unstable=True for one that its stiffness does not hold"
_NO_STIFFNESS = 1e-13  # of the largest principal stiffness: rounding
_SOFT = 1e-9  # of the same: a freedom that forces of rounding would move far, as the spin of an arm between ball joints
_CORRECTIONS = 2  # Newton steps that carry derivatives: the second corrects the rounding of the first one's stiffness


@dataclass(frozen=True)
class Balance:
    """Equilibrium of one design.

    q [n_q], lam [rows]         coordinates, and multipliers of least norm
    inverse [n_v, n_v + rows]   derivative of the increment of q by the residual (f, Phi), times -1
    failure                     why there is no equilibrium, else ""; q is then the start of the search
    instability                 why no motion should start here: an unstable degree of freedom or one without stiffness, else
                                ""
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
    sweep: int = 0,
) -> list[Balance]:
    """Equilibria of all lanes of an uncondensed system at time t, near q [n_q, 1, lanes].

    follow     search each lane near the equilibrium of the lane before
    unstable   find the nearest equilibrium, whether it is stable or not
    sweep      number of neighboring lanes that are one design at rising speeds: the first is searched downhill in energy, each
               other near the one before, stable or not; whether the rotation is steady is looked at for the fastest. A shaft
               that turns above its critical speed is held by Coriolis's forces: where the search downhill fails, the nearest
               state is taken. 0: lanes are designs by themselves
    """
    start, balances = value(q).detach(), []
    with torch.no_grad():
        values = dynamics.values()
        while len(balances) < dynamics.lanes:
            lane = len(balances)
            place = lane % sweep if sweep else 0
            near = balances[-1].q if (follow and balances) or place else start[:, 0, min(lane, start.shape[-1] - 1)]
            of_lane = values.select_lanes([lane])
            turning = _at_spin(rotation, of_lane.data)
            arguments = of_lane, near, t, turning
            fastest = place == max(sweep - 1, 0)
            balance = _find_equilibrium(*arguments, unstable or place > 0, fastest)
            if balance.failure and (sweep > 1 or (sweep and turning is not None and bool(turning.spin.any()))):
                other = _find_equilibrium(*arguments, not place, fastest)
                balance = balance if other.failure and place else other
            balances.append(balance)
            if not place and sweep > 1 and not balance.failure:
                others = values.select_lanes(list(range(lane + 1, lane + sweep)))
                balances += _sweep(others, balance.q, t, _at_spin(rotation, others.data))
    return balances


def _sweep(dynamics: Any, start: Tensor, t: Tensor, rotation: SteadyRotation | None) -> list[Balance]:
    """Equilibria of lanes at rising speeds, by Newton's method of all at once from start [n_q], that of the speed before.

    They end before the first that is not surely the one to which a search from its neighbor leads: a step from there must
    come near.
    """
    T, lanes, observer = dynamics.topology, range(dynamics.lanes), rotation and rotation.turning
    of_lanes = [dynamics.select_lanes([lane]) for lane in lanes]
    q, largest, balances = start[:, None, None].expand(-1, 1, len(lanes)), [0.0] * len(lanes), {}
    for _ in range(_SWEEP_STEPS):
        states = Linearization.each(dynamics, q, t, observer=observer)
        moves = torch.zeros(T.n_v, 1, len(lanes), dtype=q.dtype)
        for lane in [lane for lane in lanes if lane not in balances]:
            rest, of_lane = states[lane], of_lanes[lane]
            largest[lane] = max(largest[lane], float(rest.works.abs().max()))
            turning = _at_spin(rotation, of_lane.data)
            balance, _ = _balance(of_lane, rest, q[:, 0, lane], t, turning, largest[lane], lane == lanes[-1])
            if balance is not None:
                balances[lane] = balance
            elif bool(torch.isfinite(rest.forces).all()):
                moves[:, 0, lane] = _step(rest, None)
        if len(balances) == len(lanes):
            break
        q = equations.advance(T, q, moves)
    before = torch.cat([start[:, None, None], q[..., :-1]], -1)
    steps = [_step(rest, None) for rest in Linearization.each(dynamics, before, t, observer=observer)]
    after = equations.advance(T, before, torch.stack(steps, -1)[:, None])
    near = (after - q).abs().amax((0, 1)) <= _NEAR * (q - before).abs().amax((0, 1)) + _CLOSED
    sure = [lane in balances and not balances[lane].failure and bool(near[lane]) for lane in lanes]
    return [balances[lane] for lane in range([*sure, False].index(False))]


def _at_spin(rotation: SteadyRotation | None, data: Data) -> SteadyRotation | None:
    """The rotation at the spin that is among the data."""
    return rotation and rotation.of_spin(data[SPIN])


def equilibrium_coordinates(
    dynamics: Any, balances: list[Balance], t: Tensor, rotation: SteadyRotation | None = None
) -> Any:
    """Coordinates of equilibrium [n_q, 1, lanes] with their derivatives in the data, which last Newton steps carry."""
    T, data = dynamics.topology, dynamics.data
    q, lam = (torch.stack([getattr(balance, name) for balance in balances], -1)[:, None] for name in ("q", "lam"))
    inverse = torch.stack([balance.inverse for balance in balances])
    prescribed, still = T.prescribed(t, data), q.new_zeros(T.n_v, 1, q.shape[-1])
    for _ in range(_CORRECTIONS):
        at = equations.placement(T, data, q, prescribed)
        rates = (still, still) if rotation is None else rotation.of_spin(data[SPIN]).rates(T, q)
        residual = equations.dynamic_residual(T, data, at, *rates, lam)
        if T.rows:
            residual = cat([residual, equations.constraints(T, at)])
        q = equations.advance(T, q, linear(lambda x: -apply(inverse, x), residual))
    return q


def reactions(dynamics: Any, q: Any, t: Tensor, rotation: SteadyRotation | None = None) -> Any:
    """Multipliers [rows, ...] of an equilibrium q [n_q, ...] at time t, drives fixed; derivatives as q and the data have."""
    T = dynamics.topology
    still = value(q).new_zeros(T.n_v, 1, value(q).shape[-1])

    def residual(data: Data, at: equations.Placement, q: Any, x: Tensor) -> Any:
        drives, v = T.law_jets(t, data), still
        if rotation is None:
            drives = [drive and tuple(_held(jet) for jet in drive) for drive in drives]
        else:
            v, _ = rotation.of_spin(data[SPIN]).rates(T, q)
        return equations.stabilized_residual(T, data, at, v, x[: T.n_v], x[T.n_v :], drives, 0.0)

    return dynamics.zero_left_out(dynamics.solve_linear(residual, t, q)[T.n_v :])


def _held(jet: Jet) -> Jet:
    """A law whose value stays constant from now on."""
    return Jet(jet.value, *(0.0 * x for x in jet.parts[1:]))


def vibrations(dynamics: Any) -> Vibrations:
    """Vibrations of one design about its initial position, which is taken for an equilibrium."""
    with torch.no_grad():
        q, _ = dynamics.values().initial.solve(dynamics.values())
        return Vibrations.of(Linearization.of(dynamics.values(), q[:, 0, 0], q.new_zeros(()), released=True))


def _find_equilibrium(
    dynamics: Any,
    start: Tensor,
    t: Tensor,
    rotation: SteadyRotation | None = None,
    unstable: bool = False,
    all_around: bool = True,
) -> Balance:
    """The equilibrium of dynamics of one lane near start [n_q]; all_around: look whether a rotation is steady."""
    T, q = dynamics.topology, start
    turning = rotation and rotation.turning
    steps = LoadSteps(dynamics, start, t, turning) if T.has_fast_elements and not unstable else None
    if steps is not None and steps.stable:
        path = steps.run()
        if path.failure:
            return _failed(T, start, f"no static equilibrium: {path.failure}. {_SMALLER}")
        q = path.q
    rest, largest = Linearization.of(dynamics, q, t, observer=turning), 0.0
    sizes, steps_taken = rest.scale, 0
    while steps_taken < _STEPS:
        steps_taken += 1
        largest = max(largest, float(rest.works.abs().max()))
        balance, small = _balance(dynamics, rest, q, t, rotation, largest, all_around)
        if balance is not None:
            return balance if not balance.failure else _failed(T, start, balance.failure)
        if not bool((torch.isfinite(rest.forces) & (rest.scale <= _FAR * sizes)).all()):
            break
        q = equations.advance(T, q[:, None, None], _step(rest, None if unstable else small)[:, None, None])[:, 0, 0]
        rest = Linearization.of(dynamics, q, t, observer=turning)
    forces = rest.unbalanced.abs().nan_to_num(torch.inf)
    worst = T.rate_name(int(rest.active[int(forces.argmax())]), "force", "torque")
    failure = (
        f"no static equilibrium in {steps_taken} steps: {float(forces.max()):.3g} N or N m remain on {worst}. "
        "Try: a mechanism whose forces can balance, initial positions near that, and stiffnesses of springs in series "
        f"within a factor of {1.0 / _NO_STIFFNESS:.0e}"
    )
    return _failed(T, start, failure)


def _balance(
    dynamics: Any,
    rest: Linearization,
    q: Tensor,
    t: Tensor,
    rotation: SteadyRotation | None,
    largest: float,
    all_around: bool,
) -> tuple[Balance | None, Tensor]:
    """The equilibrium at q, or None where forces do not balance, and the sizes of works [active] that count as none.

    largest   of the forces of all steps; all_around: as in `_find_equilibrium`
    """
    T, canceling = dynamics.topology, _canceling(dynamics, rest, q, t)
    small = _FORCE * largest + _ROUNDING * canceling[rest.active]
    values, vectors = rest.principal_stiffness
    without_stiffness = values.abs() <= _NO_STIFFNESS * (float(values.abs().max()) if len(values) else 0.0)
    exact = _along(rest, _FORCE * largest + _LOADED * canceling[rest.active])
    largest_along = torch.where(without_stiffness, exact, _along(rest, small))
    places = float(q[: 3 * T.bodies].abs().max()) if T.bodies else 0.0
    closed = bool((rest.phi.abs() <= _CLOSED * rest.row_sizes + _ROUNDING * places).all())
    along_freedoms = vectors.T @ rest.unbalanced
    if not closed or not bool((along_freedoms.abs() <= largest_along).all()):
        return None, small
    if _mirrored(T, dynamics.values().data, q, t):
        return _failed(T, q, _MIRRORED), small
    if rotation is not None:
        same = _SAME * largest + _ROUNDING * float(canceling.max())
        if all_around and (why := unsteady(dynamics, rest, q, t, rotation, same)):
            return _failed(T, q, why), small
        if rest.negative_mass:  # centrifugal forces are wrong then; without rotation masses do not matter
            return _failed(T, q, f"no steady rotation: {NEGATIVE_MASS}. {_SMALLER}"), small
    return Balance(q, rest.lam, _inverse(rest), "", _instability(T, rest)), small


def _mirrored(T: Any, data: Data, q: Tensor, t: Tensor) -> bool:
    """True if an axis is half a turn away from its prescribed angle, where the constraint is satisfied too."""
    at = equations.placement(T, data, q[:, None, None], T.prescribed(t, data))
    for kind, vectors, drive in zip(T.primitives, at.arguments, at.drives, strict=True):
        if isinstance(kind, Angle) and drive is not None:
            x, y, b = vectors
            c, s = drive
            if bool((dot(x, b) * c + dot(y, b) * s < 0.0).any()):
                return True
    return False


def _failed(T: Any, start: Tensor, failure: str) -> Balance:
    return Balance(start, start.new_zeros(T.rows), start.new_zeros(T.n_v, T.n_v + T.rows), failure, "")


def _canceling(dynamics: Any, rest: Linearization, q: Tensor, t: Tensor) -> Tensor:
    """Sizes of the works [n_v] that cancel: of stiffness times coordinates, of joints, and of springs against each other."""
    T, data = dynamics.topology, dynamics.values().data
    n = 3 * T.bodies
    w = equations.split_q(T, q[:, None, None])[2].flatten()
    size = torch.cat([q[:n], torch.ones_like(q[:n]), w]).abs()
    works = torch.maximum(rest.scale * (rest.K.abs() @ size), rest.scale * (rest.Phi_q.abs().T @ rest.lam.abs()))
    if T.actions:
        at = equations.placement(T, data, q[:, None, None], T.prescribed(t, data))
        states = equations.action_states(T, data, at, q.new_zeros(T.n_v, 1, 1))
        is_point = torch.tensor([x.is_point for x in T.attached])
        reach = torch.where(is_point, rest.scale[0], 1.0)  # of a displacement, of a turn
        strengths = equations.strengths(T, data, states, t)
        on_body = q.new_zeros(int(T.vector_body.max()) + 1)
        for action, (_, _, directions), f in zip(T.actions, states, strengths, strict=True):
            for members, direction in zip(action.members, directions, strict=True):
                work = reach[members] * (f * direction).norm(dim=0).flatten()
                on_body.scatter_reduce_(0, T.vector_body[members], work, "amax")
        of_bodies = on_body[: T.bodies]
        works = torch.maximum(works, torch.cat([of_bodies.repeat(6), of_bodies[: T.flexible].repeat(T.modes)]))
    return works


def _step(rest: Linearization, small: Tensor | None) -> Tensor:
    """Increment [n_v] of Newton's method towards smaller energy.

    small [active]   works that balance: they move no degree of freedom that has hardly any stiffness; None: the increment to
                     the nearest equilibrium, stable or not
    """
    active, close = rest.active, -rest.right_inverse @ rest.phi
    values, vectors = rest.principal_stiffness
    along = vectors.T @ (rest.unbalanced + rest.K[active][:, active] @ close)
    if small is None:
        slide = -vectors @ (_flexibility(vectors.T @ rest.K[active][:, active] @ vectors) @ along)
    else:
        largest = float(values.abs().max()) if len(values) else 0.0
        at_rest = (values.abs() < _SOFT * largest) & (along.abs() * len(along) ** 0.5 <= _along(rest, small))
        along = torch.where(at_rest, 0.0, along)
        slide = -vectors @ (along / values.abs().clamp_min(_NO_STIFFNESS * largest or 1.0))
    total = close + slide
    step = torch.zeros_like(rest.forces)
    step[active] = total * min(1.0, _LARGEST / max(float((total / rest.scale[active]).abs().max()), 1e-300))
    return step


def _along(rest: Linearization, works: Tensor) -> Tensor:
    """Largest forces [freedoms] along the principal directions of the stiffness, out of sizes of works [active]."""
    return (rest.principal_stiffness[1].T / rest.scale[rest.active]).abs() @ works


def _inverse(rest: Linearization) -> Tensor:
    """`Balance.inverse`; degrees of freedom without stiffness do not move."""
    active, n = rest.active, len(rest.forces)
    close, K, (_, vectors) = rest.right_inverse, rest.K[rest.active][:, rest.active], rest.principal_stiffness
    slide = vectors @ _flexibility(vectors.T @ K @ vectors) @ vectors.T
    inverse = rest.forces.new_zeros(n, n + len(rest.phi))
    inverse[active[:, None], active] = slide
    inverse[active, n:] = close - slide @ K @ close
    return inverse


def _flexibility(K: Tensor) -> Tensor:
    """Inverse of a stiffness in its principal directions; degrees of freedom without stiffness do not move."""
    inverse, singular = torch.linalg.inv_ex(K)
    is_regular = not int(singular) and float(K.norm() * inverse.norm()) < 1.0 / _NO_STIFFNESS
    return inverse if is_regular else torch.linalg.pinv(K, rtol=_NO_STIFFNESS)


def _instability(T: Any, rest: Linearization) -> str:
    """`Balance.instability`."""
    values, vectors = rest.principal_stiffness
    if not len(values) or float(values[0]) > _NO_STIFFNESS * float(values.abs().max()):
        return ""
    row = int(rest.active[int((vectors[:, 0] / rest.scale[rest.active]).abs().argmax())])
    if float(values[0]) < -_NO_STIFFNESS * float(values.abs().max()):
        return (
            f"the static equilibrium is unstable: {T.rate_name(row)} falls away from it. "
            "Try: initial positions near a stable one, or start='assembled'"
        )
    return (
        f"the mechanism is free to move without a force: {T.rate_name(row)} has no static equilibrium of its own. "
        "Try: a drive, a lock, a spring or a joint that holds it, or start='assembled'"
    )
