"""Generalized-alpha on the index-3 equations of a flexible multibody system, with exact sensitivities of the step.

    (1 - am) a1 + am a0 = (1 - af) v1' + af v0'
    step  = h v0 + h^2 ((1/2 - beta) a0 + beta a1)         q1 = q0 o exp(step)   rotations on the Lie group
    v1    = v0 + h ((1 - gamma) a0 + gamma a1)
    M(q1) v1' + Phi_q' lam + s(q1, v1) + K q1 = g,         Phi(q1, t1) = 0

a is the algorithmic acceleration, v' the true one. am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 + af - am,
beta = (gamma + 1/2)^2 / 4: second order, unconditionally stable for linear systems, rho the spectral radius at infinite
frequency. Unknowns z = (v1', lam); constraint rows are divided by dq1/dv1' = beta h^2 (1 - af)/(1 - am), which makes the
iteration matrix the saddle-point matrix of the accelerations, well scaled for every h.

Iteration: z <- z - H R(z), a fixed number of times, with the inverse H of an iteration matrix frozen for a few steps
(mass, stiffness, damping, constraints, gyroscopic and geometric terms: it contracts by about 0.002). Tangents of the
*discrete* map, on the same inverse:

    R_z dz + R_x dx + R_b = 0   by   dz <- dz - H (R_z dz + R_x dx + R_b)

The first pass differentiates by everything, the following by z alone (R is linear in the tangents). Values must be
converged before the tangents are taken. No branch inside a step: its operations are in step.py.
Sources: Chung and Hulbert (1993); Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202; Bruels, Cardona, Arnold,
Mech. Mach. Theory 48 (2012) 121-137.
Checked in tests/integrators/, tests/convergence/ (order), tests/sensitivity/ (against its own discrete map).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrators import compiled
from torchmbd.integrators.step import Coefficients, State, Step, Weights, inverse
from torchmbd.numerics.pair import Pair, value
from torchmbd.system.dynamics import Dynamics


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
    lam: Tensor

    @classmethod
    def of(cls, x: State, times: int) -> History:
        """Room for `times` states like x."""
        rooms = ((y.full if isinstance(y, Pair) else y) for y in (x.q, x.v, x.vd, x.lam))
        return cls(*(y.new_zeros(times, *y.shape) for y in rooms))

    def put(self, index: int, x: State) -> None:
        for room, y in ((self.q, x.q), (self.v, x.v), (self.vd, x.vd), (self.lam, x.lam)):
            room[index] = y.full if isinstance(y, Pair) else y


def integrate(
    dynamics: Dynamics,
    duration: float,
    steps: int,
    spectral_radius: float = 0.9,
    iterations: tuple[int, int] = (3, 3),
    refresh: int = 2,
) -> tuple[History, dict[str, Any]]:
    """Integrate all lanes with `steps` equal steps.

    iterations  corrections of values and of tangents in every step
    refresh     steps between two inverses of the iteration matrix

    Returns the states at steps + 1 times, and statistics: for each lane the estimated relative error of the iteration in
    the accelerations ("iteration_error") and in their design tangents ("tangent_error").
    """
    h = duration / steps
    w = Coefficients(spectral_radius).weights(h)
    checked(iterations, refresh)
    x = initial(dynamics)
    history = History.of(x, steps + 1)
    history.put(0, x)
    errors = {"iteration_error": IterationError(x.vd.shape[0]), "tangent_error": IterationError(x.vd.shape[0])}
    step = compiled.CompiledStep.of(dynamics, x.q.shape[-1]) or Step(dynamics.topology, dynamics.saddle)
    H = None
    for i in range(steps):
        drives = step.T.prescribed(torch.tensor((i + 1) * h, dtype=torch.float64))
        z, H = _values(dynamics, step, w, x, H, drives, iterations[0], i % refresh == 0, errors["iteration_error"])
        if isinstance(x.q, Pair):
            dz = _tangents(step, w, dynamics.data, x, H, z, drives, iterations[1], errors["tangent_error"])
            z = Pair.of(z, dz)
        x = step.finish(w, x, z)
        history.put(i + 1, x)
    return history, {"steps": steps, "step_size": h} | {name: e.relative() for name, e in errors.items() if e.rows}


def _values(
    dynamics: Dynamics,
    step: Any,
    w: Weights,
    x: State,
    H: Any,
    drives: list,
    iterations: int,
    refresh: bool,
    error: IterationError,
) -> tuple[Tensor, Tensor]:
    """Unknowns of one step and the inverse used last.

    The first correction may use an old inverse: it is refreshed where that correction leads, with velocities and
    multipliers close to the final ones, which the following corrections and the tangents profit from.
    """
    z = torch.cat([value(x.vd), value(x.lam)])
    if H is None:
        H = inverse(dynamics.determined(step.matrix(w, dynamics.data, x, z, drives)))
    corrections = []
    for k in range(iterations):
        z, correction = step.correct(w, dynamics.data, x, H, z, drives)
        corrections.append(correction)
        if k == 0 and refresh:
            H = inverse(dynamics.determined(step.matrix(w, dynamics.data, x, z, drives)))
    error.add(z, corrections)
    return z, H


def _tangents(
    step: Any,
    w: Weights,
    data: Any,
    x: State,
    H: Tensor,
    z: Tensor,
    drives: list,
    iterations: int,
    error: IterationError,
) -> Tensor:
    """Design tangents of the unknowns of one step [n, n_b, lanes]."""
    R, correction, dz = step.tangent_first(w, data, x, H, z, drives)
    corrections = [correction]
    for _ in range(iterations - 1):
        R, correction, dz = step.tangent_next(w, data, x, H, z, drives, R, correction, dz)
        corrections.append(correction)
    error.add(dz, corrections)
    return dz


def checked(iterations: tuple[int, int], refresh: int) -> None:
    """Check the options of the iteration; InputError names what is wrong."""
    counts = iterations if isinstance(iterations, (tuple, list)) else ()
    if len(counts) != 2 or any(not isinstance(k, int) or k < 1 for k in counts):
        raise InputError(f"iterations is {iterations!r}; allowed: two positive integers, for values and for tangents")
    if not isinstance(refresh, int) or refresh < 1:
        raise InputError(f"refresh is {refresh!r}; allowed: a positive number of steps")


class IterationError:
    """Estimates what the fixed iteration leaves: the next correction would be |last|^2 / |one before|.

    Collected over all steps without leaving the device; relative to the largest value of the whole motion.
    """

    def __init__(self, accelerations: int):
        self.accelerations = accelerations
        self.rows: list[Tensor] = []

    def add(self, x: Tensor, corrections: list[Tensor]) -> None:
        last = [y[: self.accelerations].abs().amax((0, 1)) for y in (x, *corrections[-2:])]
        self.rows.append(torch.stack([last[0], last[-1] * last[-1] / last[1] if len(last) == 3 else last[1]]))

    def relative(self) -> Tensor:
        """Largest estimate over the largest value, for each lane."""
        size, left = torch.stack(self.rows).unbind(1)
        return left.amax(0) / size.amax(0).clamp_min(torch.finfo(size.dtype).tiny)
