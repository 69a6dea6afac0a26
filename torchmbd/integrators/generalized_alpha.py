"""Generalized-alpha on the index-3 equations of a flexible multibody system, with exact sensitivities of the step.

    (1 - am) a1 + am a0 = (1 - af) v1' + af v0'
    step  = h v0 + h^2 ((1/2 - beta) a0 + beta a1)         q1 = q0 o exp(step)   rotations on the Lie group
    v1    = v0 + h ((1 - gamma) a0 + gamma a1)
    M(q1) v1' + Phi_q' lam + s(q1, v1) + K q1 = g,         Phi(q1, t1) = 0

a is the algorithmic acceleration, v' the true one. am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 + af - am,
beta = (gamma + 1/2)^2 / 4: second order, unconditionally stable for linear systems, rho the spectral radius at infinite
frequency. Unknowns z = (v1', lam); constraint rows are divided by dq1/dv1' = beta h^2 (1 - af)/(1 - am), which makes the
iteration matrix the saddle-point matrix of the accelerations, well scaled for every h.

Iteration: z <- z - H R(z), a fixed number of times. H is the inverse of the iteration matrix, renewed before the last
correction of values: the correction before that leaves little, so the last converges like Newton's, and the tangents of
the *discrete* map are one more solution with nearly the exact matrix:

    R_z dz + R_x dx + R_b = 0   by   dz <- dz - H (R_z dz + R_x dx + R_b)

What this leaves is looked at every `CHECK` steps by a second correction; where it is too much, further steps make more.
No branch inside a step: its operations are in step.py. Bodies that joints to the ground hold simply are no unknowns
(system/condensation.py).
Sources: Chung and Hulbert (1993); Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202; Bruels, Cardona, Arnold,
Mech. Mach. Theory 48 (2012) 121-137.
Checked in tests/integrators/, tests/convergence/ (order), tests/sensitivity/ (against its own discrete map).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrators import compiled
from torchmbd.integrators.history import History, Record
from torchmbd.integrators.march import TURN, first
from torchmbd.integrators.step import Coefficients, State
from torchmbd.numerics.pair import Pair
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.equations import split_v
from torchmbd.system.expansion import Expansion

SPECTRAL_RADIUS = 0.9
GOOD_STEP = 0.01  # estimated error of a step that keeps energies within 1e-3
_STILL = 1e-12  # [kg^1/2 m] modal coordinates that are rounding only


def initial(dynamics: Dynamics) -> State:
    """Consistent initial positions, velocities and accelerations; pairs if the data are."""
    t = torch.zeros((), dtype=torch.float64)
    q, v = (_paired(x, dynamics.tangents) for x in dynamics.start)
    a, lam = dynamics.accelerations(t, q, v)
    return State(q, v, a, a, lam)


class Begun(NamedTuple):
    """A system, what a condensation leaves of it, and the initial state of that."""

    whole: Dynamics
    left: Dynamics
    start: State

    def values(self) -> Begun:
        """The same without design tangents."""
        return Begun(self.whole.values(), self.left.values(), self.start.values())


def begin(dynamics: Dynamics) -> Begun:
    """The start of a motion."""
    x, left = initial(dynamics), dynamics.condensed()
    if left is dynamics:
        return Begun(dynamics, dynamics, x)
    x = left.initial.condensation.state(x)
    return Begun(dynamics, left, x._replace(lam=left.carried(x.lam)))


def _paired(x: Any, tangents: int) -> Any:
    if isinstance(x, Pair) or not tangents:
        return x
    return Pair.of(x, x.new_zeros(1, 1, 1).expand(x.shape[0], tangents, x.shape[2]))


def integrate(
    begun: Begun,
    duration: float,
    steps: int,
    spectral_radius: float = SPECTRAL_RADIUS,
    iterations: tuple[int, int] = (3, 1),
    refresh: int = 1,
) -> tuple[History, dict[str, Any]]:
    """Integrate all lanes with `steps` equal steps, from what `begin` makes of their dynamics.

    iterations  corrections of values, and the least number of corrections of tangents, in every step
    refresh     steps between two inverses of the iteration matrix; 0: a new one before every correction

    Returns the states at steps + 1 times, and statistics: for each lane the estimated relative error of the iteration in
    the accelerations ("iteration_error") and in their design tangents ("tangent_error"), the estimated error of a step
    ("step_error", see `step_error`), the number of steps that would make it 1 % ("suggested_steps"), and the largest
    rotation of a body in one step [rad] ("turn").
    """
    checked(iterations, refresh)
    h = duration / steps
    w = Coefficients(spectral_radius).weights(h)
    whole, left, x = begun
    times = h * torch.arange(steps + 1, dtype=torch.float64)
    same = left.topology is whole.topology
    expansion = None if same else Expansion.of(left.initial.condensation, whole.data, times)
    schedule = left.topology.schedule(times[1:], left.data)
    march = compiled.march(left, w, iterations, refresh)
    record = Record(x, steps + 1)
    record.put(0, x)
    march.run(x, schedule, record)
    history = record.history(expansion)
    error = step_error(left, history, spectral_radius, h)
    suggested = (steps * (error / GOOD_STEP).sqrt()).ceil()
    turn = turns(left, history, h)
    statistics: dict[str, Any] = {"steps": steps, "step_size": h, "turn": turn.amax(0)}
    statistics |= {"step_error": error, "suggested_steps": suggested} | march.errors(history, duration)
    statistics["until"] = statistics["until"].minimum(first(turn > TURN).clamp_min(1))
    return history, statistics


def step_error(dynamics: Dynamics, history: History, spectral_radius: float, h: float) -> Tensor:
    """Estimated largest error that one step of size h adds [lanes]: h^2 |beta - 1/6| |v1' - v0'|.

    Of the modal coordinates, relative to the largest of the motion; without flexible bodies, of the rotations [rad].
    Source: Zienkiewicz and Xie, Earthq. Eng. Struct. Dyn. 20 (1991) 871-887.
    """
    T = dynamics.topology
    modes = T.modes * T.flexible
    accelerations = history.vd[:, :, 0].transpose(0, 1)
    rows = split_v(T, accelerations)[2 if modes else 1].flatten(0, 1)
    change = rows[:, 1:] - rows[:, :-1]
    error = h * h * abs(Coefficients(spectral_radius).beta - 1.0 / 6.0) * change.square().sum(0).sqrt().amax(0)
    if not modes:
        return error
    largest = history.q[:, T.n_q - modes :, 0].square().sum(1).sqrt().amax(0)
    return error / largest.clamp_min(_STILL)


def turns(dynamics: Dynamics, history: History, h: float) -> Tensor:
    """Largest rotation of a body in a step from each time [times, lanes] [rad]."""
    omega = split_v(dynamics.topology, history.v[:, :, 0].transpose(0, 1))[1]
    return h * omega.square().sum(0).sqrt().amax(0)


def checked(iterations: tuple[int, int], refresh: int) -> None:
    """Check the options of the iteration; InputError names what is wrong."""
    counts = iterations if isinstance(iterations, (tuple, list)) else ()
    if len(counts) != 2 or any(not isinstance(k, int) or k < 1 for k in counts):
        raise InputError(f"iterations is {iterations!r}; allowed: two positive integers, for values and for tangents")
    if not isinstance(refresh, int) or refresh < 0:
        raise InputError(f"refresh is {refresh!r}; allowed: a number of steps, or 0 for every correction")
