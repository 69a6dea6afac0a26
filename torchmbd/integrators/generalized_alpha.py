"""Generalized-alpha on the index-3 equations of a flexible multibody system, with exact sensitivities of the step.

    (1 - am) a1 + am a0 = (1 - af) v1' + af v0'
    step  = h v0 + h^2 ((1/2 - beta) a0 + beta a1)         q1 = q0 o exp(step)   rotations on the Lie group
    v1    = v0 + h ((1 - gamma) a0 + gamma a1)
    M(q1) v1' + Phi_q' lam + s(q1, v1) + K q1 = g,         Phi(q1, t1) = 0

a is the algorithmic acceleration, v' the true one. am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 + af - am,
beta = (gamma + 1/2)^2 / 4: second order, unconditionally stable for linear systems, rho the spectral radius at infinite
frequency. Unknowns z = (v1', lam); constraint rows are divided by dq1/dv1' = beta h^2 (1 - af)/(1 - am), which makes the
iteration matrix the saddle-point matrix of the accelerations, well scaled for every h.

Iteration: z <- z - H R(z) with the inverse H of a matrix frozen for several steps (mass, stiffness, damping, constraints;
gyroscopic and geometric terms dropped), a fixed number of times. Tangents of the *discrete* map, on the same inverse:

    R_z dz + R_x dx + R_b = 0   by   dz <- dz - H (R_z dz + R_x dx + R_b)

The first pass differentiates by everything, the following by z alone (R is linear in the tangents). Values must be
converged before the tangents are taken. No branch inside a step.
Sources: Chung and Hulbert (1993); Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202; Bruels, Cardona, Arnold,
Mech. Mach. Theory 48 (2012) 121-137.
Checked in tests/integrators/, tests/convergence/ (order), tests/sensitivity/ (against its own discrete map).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.numerics.pair import Pair, cat, combine, value
from torchmbd.system import equations
from torchmbd.system.dynamics import Dynamics


class State(NamedTuple):
    """q [n_q, ...], v, vd (true), a (algorithmic) [n_v, ...], lam [rows, ...]; tensors or pairs."""

    q: Any
    v: Any
    vd: Any
    a: Any
    lam: Any

    def map(self, f) -> State:
        return State(*(f(x) for x in self))

    def values(self) -> State:
        return self.map(value)


@dataclass(frozen=True)
class Coefficients:
    """Coefficients of the method for a spectral radius 0 <= rho <= 1 at infinite frequency."""

    rho: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.rho <= 1.0:
            raise InputError(f"spectral_radius is {self.rho!r}; allowed: 0 (strong damping) to 1 (none)")

    @property
    def am(self) -> float:
        return (2.0 * self.rho - 1.0) / (self.rho + 1.0)

    @property
    def af(self) -> float:
        return self.rho / (self.rho + 1.0)

    @property
    def gamma(self) -> float:
        return 0.5 + self.af - self.am

    @property
    def beta(self) -> float:
        return 0.25 * (self.gamma + 0.5) ** 2

    @property
    def share(self) -> float:
        """da1/dv1'."""
        return (1.0 - self.af) / (1.0 - self.am)


class Step:
    """One step of size h: the residual, the frozen inverse, values and tangents."""

    def __init__(self, dynamics: Dynamics, h: float, coefficients: Coefficients, iterations: tuple[int, int]):
        self.T, self.saddle, self.h, self.c, self.iterations = (
            dynamics.topology,
            dynamics.saddle,
            h,
            coefficients,
            iterations,
        )
        self.scale = coefficients.beta * h * h * coefficients.share  # dq1/dv1'

    def begin(self, x: State) -> State:
        """What the known state gives to q (as an increment), v and a at the end of the step; share of v1' left out."""
        c, h = self.c, self.h
        a = combine((c.af / (1.0 - c.am)) * x.vd, -c.am / (1.0 - c.am), x.a)
        step = combine(combine(h * x.v, h * h * (0.5 - c.beta), x.a), h * h * c.beta, a)
        v = combine(combine(x.v, h * (1.0 - c.gamma), x.a), h * c.gamma, a)
        return State(step, v, x.vd, a, x.lam)

    def end(self, x: State, known: State, vd) -> tuple[Any, Any]:
        """q and v at the end of the step for accelerations v1'."""
        q = equations.advance(self.T, x.q, combine(known.q, self.scale, vd))
        return q, combine(known.v, self.c.gamma * self.h * self.c.share, vd)

    def matrix(self, data: equations.Data, x: State, known: State, z: Tensor, drives: list) -> Tensor:
        """Iteration matrix dR/dz [lanes, n, n] at the end of the step from x, for unknowns z; nearly exact."""
        T = self.T
        q, v = self.end(x, known, z[: T.n_v])
        at = equations.placement(T, data, q, drives)
        K = self.saddle.matrix(data, at, self.scale, self.c.gamma * self.h * self.c.share, v, z[T.n_v :])
        # A change of the increment turns the body by d(exp), not by the change itself: to first order 1 - h ~om / 2.
        turns = K[:, T.n_v :, 3 * T.bodies : 6 * T.bodies].unflatten(2, (3, T.bodies))
        spin = equations.split_v(T, v)[1][:, :, 0].permute(2, 0, 1)[:, None].expand_as(turns)
        turns -= (0.5 * self.h) * torch.linalg.cross(turns, spin, dim=2)
        return K

    def residual(self, data: equations.Data, x: State, known: State, z, drives: list):
        """R [n_v + rows, ...] of the unknowns z = (v1', lam) after the state x."""
        T = self.T
        vd, lam = z[: T.n_v], z[T.n_v :]
        q, v = self.end(x, known, vd)
        at = equations.placement(T, data, q, drives)
        forces = equations.dynamic_residual(T, data, at, v, vd, lam)
        return cat([forces, equations.constraints(T, at) * (1.0 / self.scale)]) if T.rows else forces

    def values(
        self, data: equations.Data, x: State, H: Tensor | None, drives: list, refresh: bool
    ) -> tuple[Tensor, list[Tensor], Tensor]:
        """Unknowns z [n, 1, lanes], the corrections that led to them, and the inverse used last.

        The first correction may use an old inverse: it is refreshed where that correction leads, with velocities and
        multipliers close to the final ones, which the following corrections and the tangents profit from.
        """
        known = self.begin(x)
        z = torch.cat([x.vd, x.lam])
        if H is None:
            H = inverse(self.matrix(data, x, known, z, drives))
        corrections: list[Tensor] = []
        for k in range(self.iterations[0]):
            corrections.append(apply(H, self.residual(data, x, known, z, drives)))
            z = z - corrections[-1]
            if k == 0 and refresh:
                H = inverse(self.matrix(data, x, known, z, drives))
        return z, corrections, H

    def tangents(
        self, data: equations.Data, x: State, z: Tensor, H: Tensor, drives: list
    ) -> tuple[Tensor, list[Tensor]]:
        """Design tangents of the unknowns [n, slots, lanes], and the corrections that led to them."""
        start = cat([x.vd, x.lam]).tangent
        R = self.residual(data, x, self.begin(x), Pair.of(z, start), drives).tangent
        corrections = [apply(H, R)]
        dz = start - corrections[-1]
        plain, frozen = {name: value(y) for name, y in data.items()}, x.values()
        known = self.begin(frozen)
        for _ in range(self.iterations[1] - 1):
            R = R - self.residual(plain, frozen, known, Pair.of(z, corrections[-1]), drives).tangent
            corrections.append(apply(H, R))
            dz = dz - corrections[-1]
        return dz, corrections

    def finish(self, x: State, z) -> State:
        """The new state of converged unknowns."""
        vd, lam = z[: self.T.n_v], z[self.T.n_v :]
        known = self.begin(x)
        q, v = self.end(x, known, vd)
        return State(q, v, vd, combine(known.a, self.c.share, vd), lam)


def inverse(K: Tensor) -> Tensor:
    """Inverses of matrices [lanes, n, n]. A lane whose matrix is singular becomes nan, alone."""
    H, info = torch.linalg.inv_ex(K)
    return torch.where((info == 0)[:, None, None], H, torch.nan)


def apply(H: Tensor, R: Tensor) -> Tensor:
    """Multiply right-hand sides [n, slots, lanes] by matrices [lanes, n, n]."""
    return torch.bmm(H, R.permute(2, 0, 1)).permute(1, 2, 0)


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
    step = Step(dynamics, h, Coefficients(spectral_radius), checked(iterations, refresh))
    plain = dynamics.values().data
    x = initial(dynamics)
    history = History.of(x, steps + 1)
    history.put(0, x)
    errors = {"iteration_error": _IterationError(step.T.n_v), "tangent_error": _IterationError(step.T.n_v)}
    H = None
    for i in range(steps):
        drives = step.T.prescribed(torch.tensor((i + 1) * h, dtype=torch.float64))
        z, corrections, H = step.values(plain, x.values(), H, drives, i % refresh == 0)
        errors["iteration_error"].add(z, corrections)
        if isinstance(x.q, Pair):
            dz, corrections = step.tangents(dynamics.data, x, z, H, drives)
            errors["tangent_error"].add(dz, corrections)
            z = Pair.of(z, dz)
        x = step.finish(x, z)
        history.put(i + 1, x)
    return history, {"steps": steps, "step_size": h} | {name: e.relative() for name, e in errors.items() if e.rows}


def checked(iterations: tuple[int, int], refresh: int) -> tuple[int, int]:
    """Check the options of the iteration; InputError names what is wrong."""
    counts = iterations if isinstance(iterations, (tuple, list)) else ()
    if len(counts) != 2 or any(not isinstance(k, int) or k < 1 for k in counts):
        raise InputError(f"iterations is {iterations!r}; allowed: two positive integers, for values and for tangents")
    if not isinstance(refresh, int) or refresh < 1:
        raise InputError(f"refresh is {refresh!r}; allowed: a positive number of steps")
    return (iterations[0], iterations[1])


class _IterationError:
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
