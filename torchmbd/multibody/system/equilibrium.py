"""Static equilibrium of an assembled mechanism, and its vibrations about it.

    f(q) + Phi_q' lam = 0,  Phi(q, t0) = 0

    dq = -Phi_q^+ Phi + N z,   |N' K N| z = -N' (f + K dq_0)          |A|: symmetric part, eigenvalues taken positive

With positive eigenvalues every step goes downhill in energy, so a conservative mechanism ends at a stable equilibrium
and not at the nearest extremum (but one that starts exactly at an unstable one stays there, and says so). Steps are
limited in size.
Checked in tests/multibody/system/test_equilibrium.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.module_call import exclusive
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.linearized import AtRest, Vibrations

_STEPS, _LARGEST = 200, 0.3  # Newton steps; largest increment of a coordinate [m], [rad]
_FORCE, _CLOSED = 1e-10, 1e-11  # forces that remain, of the largest; violation of a joint


@dataclass(frozen=True)
class Equilibrium:
    """Positions q [lanes, n_q] and multipliers lam [lanes, rows] at rest; vibrations about it, one for each lane."""

    q: Tensor
    lam: Tensor
    vibrations: list[Vibrations]

    @property
    def frequencies(self) -> Tensor:
        """Natural frequencies [lanes, freedoms] [Hz]; see Vibrations."""
        return torch.stack([x.frequencies for x in self.vibrations])

    @property
    def stable(self) -> bool:
        """Whether no freedom of any lane is unstable."""
        return not bool(self.frequencies.isnan().any())


@exclusive
def equilibrium(model: Any) -> Equilibrium:
    """Static equilibrium near the initial position, drives held at t = 0.

    model  a System (one design) or its Dynamics (lanes)

    Returns q [lanes, n_q] [m, -], multipliers lam [lanes, rows] [N, N m], and frequencies [lanes, freedoms] [Hz].
    Raises InputError with the forces that remain if there is none.

    >>> rest = mbd.equilibrium(mbd.examples.pendulum(length=2.0))
    >>> round(rest.frequencies.item(), 4), rest.stable  # sqrt(9.81 / 2) / (2 pi) [Hz]
    (0.3525, True)
    """
    if not (hasattr(model, "with_joints") or hasattr(model, "initial_state")):
        raise InputError(f"equilibrium of {model!r}; allowed: a System or its Dynamics")
    dynamics = (model.dynamics() if hasattr(model, "with_joints") else model).values()
    q, lam, vibrations = [], [], []
    with torch.no_grad():
        start, _ = dynamics.initial.solve(dynamics)
        for lane in range(dynamics.lanes):
            one = dynamics.some([lane])
            at, rest = _settle(one, start[:, 0, lane if start.shape[-1] > 1 else 0])
            q.append(at)
            lam.append(rest.lam)
            vibrations.append(Vibrations.of(rest))
    return Equilibrium(torch.stack(q), torch.stack(lam), vibrations)


def vibrations(dynamics: Any) -> Vibrations:
    """Vibrations of one design about its initial position, as if it rested there."""
    with torch.no_grad():
        q, _ = dynamics.values().initial.solve(dynamics.values())
        return Vibrations.of(AtRest.of(dynamics.values(), q[:, 0, 0], q.new_zeros(())))


def _settle(dynamics: Any, q: Tensor) -> tuple[Tensor, AtRest]:
    T, t = dynamics.topology, q.new_zeros(())
    rest = AtRest.of(dynamics, q, t)
    for _ in range(_STEPS):
        if _settled(rest):
            return q, rest
        q = equations.advance(T, q[:, None, None], _step(rest)[:, None, None])[:, 0, 0]
        rest = AtRest.of(dynamics, q, t)
    left = rest.remaining.abs()
    worst = int(rest.own[int(left.argmax())])
    raise InputError(
        f"no static equilibrium in {_STEPS} steps: {float(left.max()):.3g} N or N m remain on {_name(T, worst)}; "
        "allowed: a mechanism whose forces can balance, and initial positions near that"
    )


def _settled(rest: AtRest) -> bool:
    scale = float(rest.forces.abs().max()) + 1e-300
    closed = not rest.phi.numel() or float(rest.phi.abs().max()) < _CLOSED
    return closed and _largest(rest) < _FORCE * scale


def _largest(rest: AtRest) -> float:
    free = rest.N.T @ rest.remaining
    return float(free.abs().max()) if free.numel() else 0.0


def _step(rest: AtRest) -> Tensor:
    own, J = rest.own, rest.Phi_q[:, rest.own]
    close = -torch.linalg.pinv(J, rtol=1e-9) @ rest.phi
    K = rest.reduced(rest.K)
    values, vectors = torch.linalg.eigh(0.5 * (K + K.T))
    largest = float(values.abs().max()) if len(values) else 0.0
    stiff = values.abs().clamp_min(1e-9 * largest or 1.0)
    downhill = rest.N.T @ (rest.remaining + rest.K[own][:, own] @ close)
    slide = rest.N @ (vectors @ (-(vectors.T @ downhill) / stiff))
    total = close + slide
    step = torch.zeros_like(rest.forces)
    step[own] = total * min(1.0, _LARGEST / max(float(total.abs().max()), 1e-300))
    return step


def _name(T: Any, row: int) -> str:
    if row < 6 * T.bodies:
        return (
            f"{'force' if row < 3 * T.bodies else 'torque'} {'xyz'[row // T.bodies % 3]} of {T.names[row % T.bodies]!r}"
        )
    return f"a mode of {T.names[(row - 6 * T.bodies) % T.flexible]!r}"
