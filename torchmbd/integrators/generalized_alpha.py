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
from torchmbd.numerics.pair import Pair, cat, value
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
        self.T, self.saddle, self.h, self.c, self.iterations = dynamics.topology, dynamics.saddle, h, coefficients, iterations
        self.scale = coefficients.beta * h * h * coefficients.share  # dq1/dv1'

    def inverse(self, data: equations.Data, x: State, t: Tensor) -> Tensor:
        """Inverse of the iteration matrix [lanes, n, n] where the step from x is predicted to end.

        A lane whose matrix is singular becomes nan, alone.
        """
        T = self.T
        q, v, _ = self._new(x, x.vd)
        at = equations.placement(T, data, q)
        K = self.saddle.matrix(data, at, t, self.scale, self.c.gamma * self.h * self.c.share, v, x.lam)
        # A change of the increment turns the body by d(exp), not by the change itself: to first order 1 - h ~om / 2.
        turns = K[:, T.n_v :, 3 * T.bodies : 6 * T.bodies].unflatten(2, (3, T.bodies))
        spin = equations.split_v(T, v)[1][:, :, 0].permute(2, 0, 1)[:, None].expand_as(turns)
        turns -= (0.5 * self.h) * torch.linalg.cross(turns, spin, dim=2)
        H, info = torch.linalg.inv_ex(K)
        return torch.where((info == 0)[:, None, None], H, torch.nan)

    def _new(self, x: State, vd) -> tuple[Any, Any, Any]:
        c, h = self.c, self.h
        a = c.share * vd + (c.af / (1.0 - c.am)) * x.vd - (c.am / (1.0 - c.am)) * x.a
        step = h * x.v + (h * h * (0.5 - c.beta)) * x.a + (h * h * c.beta) * a
        v = x.v + (h * (1.0 - c.gamma)) * x.a + (h * c.gamma) * a
        return equations.advance(self.T, x.q, step), v, a

    def residual(self, data: equations.Data, x: State, z, t: Tensor):
        """R [n_v + rows, ...] of the unknowns z = (v1', lam) after the state x."""
        T = self.T
        vd, lam = z[: T.n_v], z[T.n_v :]
        q, v, _ = self._new(x, vd)
        at = equations.placement(T, data, q)
        forces = equations.dynamic_residual(T, data, at, v, vd, lam, t)
        return cat([forces, equations.constraints(T, at, t) * (1.0 / self.scale)]) if T.rows else forces

    def values(self, data: equations.Data, x: State, H: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Unknowns z [n, 1, lanes], and the last correction of them."""
        z = torch.cat([x.vd, x.lam])
        correction = z
        for _ in range(self.iterations[0]):
            correction = apply(H, self.residual(data, x, z, t))
            z = z - correction
        return z, correction

    def tangents(self, data: equations.Data, x: State, z: Tensor, H: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Design tangents of the unknowns [n, slots, lanes], and the last correction of them."""
        start = cat([x.vd, x.lam]).tangent
        R = self.residual(data, x, Pair(z, start), t).tangent
        if R is None:
            raise InputError("tangents were asked for, but neither the data nor the state carry any")
        correction = -apply(H, R)
        dz = correction if start is None else start + correction
        plain, frozen = {name: value(y) for name, y in data.items()}, x.values()
        for _ in range(self.iterations[1] - 1):
            R = R + self.residual(plain, frozen, Pair(z, correction), t).tangent
            correction = -apply(H, R)
            dz = dz + correction
        return dz, correction

    def finish(self, x: State, z) -> State:
        """The new state of converged unknowns."""
        vd, lam = z[: self.T.n_v], z[self.T.n_v :]
        q, v, a = self._new(x, vd)
        return State(q, v, vd, a, lam)


def apply(H: Tensor, R: Tensor) -> Tensor:
    """Multiply right-hand sides [n, slots, lanes] by matrices [lanes, n, n]."""
    return torch.bmm(H, R.permute(2, 0, 1)).permute(1, 2, 0)


def initial(dynamics: Dynamics) -> State:
    """Consistent initial positions, velocities and accelerations; pairs if the data are."""
    t = torch.zeros((), dtype=torch.float64)
    q, v = dynamics.initial.solve(dynamics)
    if dynamics.tangents:
        q, v = (x if isinstance(x, Pair) else Pair(x) for x in (q, v))
    a, lam = dynamics.accelerations(t, q, v)
    return State(q, v, a, a, lam)


@dataclass
class History:
    """States at all times, [times, component, slots, lanes]."""

    q: Tensor
    v: Tensor
    vd: Tensor
    lam: Tensor

    @classmethod
    def of(cls, x: State, times: int) -> History:
        """Room for `times` states like x: slot 0 the value, then the design tangents."""
        slots = 1 + max((y.tangent.shape[-2] for y in x if isinstance(y, Pair) and y.tangent is not None), default=0)
        lanes = value(x.q).shape[-1]

        def room(y) -> Tensor:
            return value(y).new_zeros(times, y.shape[0], slots, lanes)

        return cls(room(x.q), room(x.v), room(x.vd), room(x.lam))

    def put(self, index: int, x: State) -> None:
        for room, y in ((self.q, x.q), (self.v, x.v), (self.vd, x.vd), (self.lam, x.lam)):
            room[index, :, :1] = value(y)
            if isinstance(y, Pair) and y.tangent is not None:
                room[index, :, 1:] = y.tangent


def integrate(
    dynamics: Dynamics,
    duration: float,
    steps: int,
    spectral_radius: float = 0.9,
    iterations: tuple[int, int] = (3, 3),
    refresh: int = 5,
) -> tuple[History, dict[str, Any]]:
    """Integrate all lanes with `steps` equal steps.

    iterations  corrections of values and of tangents in every step
    refresh     steps between two inverses of the iteration matrix

    Returns the states at steps + 1 times, and statistics: for each lane the largest remaining correction of the
    accelerations relative to their largest value ("correction"), and of the tangents ("tangent_correction").
    """
    h = duration / steps
    step = Step(dynamics, h, Coefficients(spectral_radius), iterations)
    plain = dynamics.values().data
    x = initial(dynamics)
    with_tangents = dynamics.tangents > 0
    history = History.of(x, steps + 1)
    history.put(0, x)
    monitor = _Monitor(value(x.vd).shape[-1])
    H = torch.empty(0)
    for i in range(steps):
        t = torch.tensor((i + 1) * h, dtype=torch.float64)
        if i % refresh == 0:
            H = step.inverse(plain, x.values(), t)
        z, correction = step.values(plain, x.values(), H, t)
        monitor.values(z, correction, step.T.n_v)
        if with_tangents:
            dz, correction = step.tangents(dynamics.data, x, z, H, t)
            monitor.tangents(dz, correction, step.T.n_v)
            z = Pair(z, dz)
        x = step.finish(x, z)
        history.put(i + 1, x)
    return history, {"steps": steps, "step_size": h} | monitor.summary()


class _Monitor:
    """The largest last correction of any step, against the largest unknown, for each lane."""

    def __init__(self, lanes: int):
        self.largest = [torch.zeros(lanes, dtype=torch.float64) for _ in range(4)]

    def _keep(self, k: int, x: Tensor) -> None:
        self.largest[k] = torch.maximum(self.largest[k], x.abs().amax((0, 1)))

    def values(self, z: Tensor, correction: Tensor, n: int) -> None:
        self._keep(0, z[:n])
        self._keep(1, correction[:n])

    def tangents(self, dz: Tensor, correction: Tensor, n: int) -> None:
        self._keep(2, dz[:n])
        self._keep(3, correction[:n])

    def summary(self) -> dict[str, Tensor]:
        z, dz, tangent, d_tangent = self.largest
        tiny = torch.finfo(torch.float64).tiny
        return {"correction": dz / z.clamp_min(tiny), "tangent_correction": d_tangent / tangent.clamp_min(tiny)}


