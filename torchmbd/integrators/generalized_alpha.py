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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrators import compiled
from torchmbd.integrators.step import Coefficients, Model, State
from torchmbd.numerics.pair import Pair, value
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.elimination import Elimination, inverse, pays
from torchmbd.system.equations import split_v
from torchmbd.system.reactions import multipliers

CHECK = 25  # steps between two looks at what the correction of tangents leaves
TANGENT_ERROR = 5e-6  # relative; more than this gets another correction
MOST = 4  # corrections of tangents
GOOD_STEP = 0.01  # estimated error of a step that keeps energies within 1e-3
_ROUNDING = 1e-12  # of coordinates, with room for what equations and inverse make of it
_STILL = 1e-12  # [kg^1/2 m] modal coordinates that are rounding only


def initial(dynamics: Dynamics) -> State:
    """Consistent initial positions, velocities and accelerations; pairs if the data are."""
    t = torch.zeros((), dtype=torch.float64)
    q, v = (_paired(x, dynamics.tangents) for x in dynamics.initial.solve(dynamics))
    a, lam = dynamics.accelerations(t, q, v)
    return State(q, v, a, a, lam)


def _paired(x: Any, tangents: int) -> Any:
    if isinstance(x, Pair) or not tangents:
        return x
    return Pair.of(x, x.new_zeros(1, 1, 1).expand(x.shape[0], tangents, x.shape[2]))


@dataclass
class History:
    """States at all times [times, component, 1 + n_b, lanes]: values, then design tangents."""

    q: Tensor
    v: Tensor
    vd: Tensor
    multipliers: Callable[[], Tensor]

    @cached_property
    def lam(self) -> Tensor:
        """Multipliers, computed when somebody asks."""
        return self.multipliers()

    @classmethod
    def of(cls, states: list[State]) -> History:
        """Stack states."""
        record = Record(states[0], len(states))
        for i, x in enumerate(states):
            record.put(i, x)
        return record.history()


class Record:
    """States as they come, in arrays of their final size: nothing is kept twice."""

    def __init__(self, x: State, count: int):
        shapes = [y.shape for y in (x.q, x.v, x.vd, x.lam)]
        lanes = max(shape[-1] for shape in shapes)
        self.parts = [value(x.q).new_empty(count, *shape[:-1], lanes) for shape in shapes]

    def put(self, i: int, x: State) -> None:
        """Keep the state of time i."""
        for part, y in zip(self.parts, (x.q, x.v, x.vd, x.lam), strict=True):
            part[i] = y.full if isinstance(y, Pair) else y

    def history(self) -> History:
        """What was kept."""
        q, v, vd, lam = self.parts
        return History(q, v, vd, lambda: lam)


def integrate(
    dynamics: Dynamics,
    duration: float,
    steps: int,
    spectral_radius: float = 0.9,
    iterations: tuple[int, int] = (3, 1),
    refresh: int = 1,
) -> tuple[History, dict[str, Any]]:
    """Integrate all lanes with `steps` equal steps.

    iterations  corrections of values, and the least number of corrections of tangents, in every step
    refresh     steps between two inverses of the iteration matrix

    Returns the states at steps + 1 times, and statistics: for each lane the estimated relative error of the iteration in
    the accelerations ("iteration_error") and in their design tangents ("tangent_error"), the estimated error of a step
    ("step_error", see `step_error`), the number of steps that would make it 1 % ("suggested_steps"), and the largest
    rotation of a body in one step [rad] ("turn").
    """
    checked(iterations, refresh)
    h = duration / steps
    w = Coefficients(spectral_radius).weights(h)
    x = initial(dynamics)
    left = dynamics.condensed()
    if left is not dynamics:
        x = left.initial.condensation.state(x)
        x = x._replace(lam=left.carried(x.lam))
    model = compiled.CompiledModel.of(left, x, w) or Model(left.topology, left.saddle, w, left.data)
    march = March(left, model, iterations, refresh)
    times = h * torch.arange(steps + 1, dtype=torch.float64)
    record = Record(x, steps + 1)
    record.put(0, x)
    for i, given in enumerate(left.topology.schedule(times[1:])):
        x = march(i, x, given)
        record.put(i + 1, x)
    history = record.history()
    error = step_error(left, history, spectral_radius, h)
    suggested = (steps * (error / GOOD_STEP).sqrt()).ceil()
    statistics: dict[str, Any] = {"steps": steps, "step_size": h, "turn": largest_turn(left, history, h)}
    statistics |= {"step_error": error, "suggested_steps": suggested} | march.errors(history, duration)
    del history
    return _whole(dynamics, left, times, record), statistics


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


def largest_turn(dynamics: Dynamics, history: History, h: float) -> Tensor:
    """Largest rotation in one step [lanes] [rad]."""
    omega = split_v(dynamics.topology, history.v[:, :, 0].transpose(0, 1))[1]
    return h * omega.square().sum(0).sqrt().amax((0, 1))


def _whole(dynamics: Dynamics, left: Dynamics, times: Tensor, record: Record) -> History:
    """The motion of the whole system, of which `left` was integrated; empties the record."""
    if left is dynamics:
        return record.history()
    c = left.initial.condensation
    lam = record.parts.pop()
    q, v, vd = c.expand(times, record.parts)
    return History(q, v, vd, lambda: multipliers(c, dynamics.data, times, q, v, vd, lam))


class March:
    """Steps of one simulation; keeps the inverse and what the iterations leave."""

    def __init__(self, dynamics: Dynamics, model: Any, iterations: tuple[int, int], refresh: int):
        self.dynamics, self.model, self.refresh = dynamics, model, refresh
        self.corrections, self.passes = iterations
        self.invert = Elimination(dynamics.topology) if pays(dynamics.topology) else inverse
        self.H: Tensor | None = None
        self.sizes: list[Tensor] = []  # of the last two corrections of values [2, lanes], for each step
        self.tangent_error: list[Tensor] = []  # relative [lanes], at each look

    def __call__(self, i: int, x: State, given: Any) -> State:
        step = self.model.step(x, given)
        z = self._values(step, torch.cat([value(x.vd), value(x.lam)]), renew=i % self.refresh == 0)
        if not isinstance(x.q, Pair):
            return step.finish(z)
        dz = torch.cat([x.vd.tangent, x.lam.tangent])
        for _ in range(self.passes):
            dz, _ = step.tangent(self.H, z, dz)
        if i % CHECK == 0:
            dz = self._looked(step, z, dz)
        return step.finish(z, dz)

    def _inverse(self, step: Any, z: Tensor) -> Tensor:
        return self.invert(self.dynamics.determined(step.matrix(z)))

    def _values(self, step: Any, z: Tensor, renew: bool) -> Tensor:
        """Unknowns of one step."""
        H = self._inverse(step, z) if self.H is None else self.H
        sizes = []
        for k in range(self.corrections):
            if renew and k == max(self.corrections - 1, 1):
                H = self._inverse(step, z)
            z, size = step.correct(H, z)
            sizes.append(size)
        self.H = self._inverse(step, z) if renew and self.corrections == 1 else H
        self.sizes.append(torch.stack([sizes[max(self.corrections - 2, 0)], sizes[-1]]))
        return z

    def _looked(self, step: Any, z: Tensor, dz: Tensor) -> Tensor:
        """Tangents corrected once more; where that was needed, later steps will do it as well."""
        dz, size = step.tangent(self.H, z, dz)
        largest = dz[: self.dynamics.topology.n_v].abs().amax((0, 1))
        error = size / largest.clamp_min(torch.finfo(largest.dtype).tiny)
        self.tangent_error.append(error)
        if self.passes < MOST and bool((error > TANGENT_ERROR).any()):
            self.passes += 1
        return dz

    def errors(self, history: History, duration: float) -> dict[str, Tensor]:
        """Estimated relative errors of the iteration [lanes].

        The next correction of values would be |last|^2 / |one before|, relative to the largest acceleration of the
        motion, or to the largest rate over the duration: a uniform motion has accelerations of rounding size. Or to what
        the rounding of coordinates makes of them: a system at rest has nothing else.
        """
        before, last = torch.stack(self.sizes, -1)
        left = last if self.corrections == 1 else last * last / before.clamp_min(torch.finfo(last.dtype).tiny)
        largest, uniform = (x[:, :, 0].abs().amax((0, 1)) for x in (history.vd, history.v))
        h = duration / (len(history.q) - 1)
        rounding = _ROUNDING * history.q[0, :, 0].abs().amax(0) / (h * h)
        largest = largest.maximum(uniform / duration).maximum(rounding)
        found = {"iteration_error": left.amax(-1) / largest}
        return found | ({"tangent_error": torch.stack(self.tangent_error).amax(0)} if self.tangent_error else {})


def checked(iterations: tuple[int, int], refresh: int) -> None:
    """Check the options of the iteration; InputError names what is wrong."""
    counts = iterations if isinstance(iterations, (tuple, list)) else ()
    if len(counts) != 2 or any(not isinstance(k, int) or k < 1 for k in counts):
        raise InputError(f"iterations is {iterations!r}; allowed: two positive integers, for values and for tangents")
    if not isinstance(refresh, int) or refresh < 1:
        raise InputError(f"refresh is {refresh!r}; allowed: a positive number of steps")
