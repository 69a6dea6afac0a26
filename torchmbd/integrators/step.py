"""One step of generalized-alpha: the operations that the integrator is made of (see generalized_alpha.py).

Each is a pure function of tensors: no branch on numbers, nothing kept. So each can be compiled as it stands
(compiled.py), and the eager and the compiled integrator are one text.

    correct        z <- z - H R(z)                                       values
    matrix         dR/dz, nearly exact                                   values
    tangent_first  dz <- dz - H (R_z dz + R_x dx + R_b)                  all tangents of state and data
    tangent_next   dz <- dz - H (the same for the correction before)     R is linear in the tangents
    finish         the new state of converged unknowns                   values and tangents

x is the state at the start of the step, z = (v1', lam) the unknowns [n, 1, lanes], H the inverse [lanes, n, n],
`drives` what the laws prescribe at its end, w the weights of the method.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.numerics.pair import Pair, cat, combine, value
from torchmbd.system import equations
from torchmbd.system.saddle import Saddle
from torchmbd.system.topology import Topology


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

    def weights(self, h: float) -> Weights:
        """Weights of a step of size h [s]."""
        scale = self.beta * h * h * self.share
        return Weights(
            share=self.share,
            a_from_vd=self.af / (1.0 - self.am),
            a_from_a=-self.am / (1.0 - self.am),
            h=h,
            step_from_a=h * h * (0.5 - self.beta),
            step_from_new=h * h * self.beta,
            v_from_a=h * (1.0 - self.gamma),
            v_from_new=h * self.gamma,
            scale=scale,
            rate=self.gamma * h * self.share,
            inverse_scale=1.0 / scale,
            half=0.5 * h,
        )


class Weights(NamedTuple):
    """Numbers of one method and step size; floats, or tensors without axes for a compiled step."""

    share: Any  # da1/dv1'
    a_from_vd: Any
    a_from_a: Any
    h: Any
    step_from_a: Any
    step_from_new: Any
    v_from_a: Any
    v_from_new: Any
    scale: Any  # dq1/dv1'
    rate: Any  # dv1/dv1'
    inverse_scale: Any
    half: Any


class Step:
    """The operations of a step of one topology."""

    def __init__(self, topology: Topology, saddle: Saddle):
        self.T, self.saddle = topology, saddle

    def _known(self, w: Weights, x: State) -> State:
        """What the known state gives to q (as an increment), v and a at the end of the step."""
        a = combine(w.a_from_vd * x.vd, w.a_from_a, x.a)
        step = combine(combine(w.h * x.v, w.step_from_a, x.a), w.step_from_new, a)
        v = combine(combine(x.v, w.v_from_a, x.a), w.v_from_new, a)
        return State(step, v, x.vd, a, x.lam)

    def _end(self, w: Weights, x: State, known: State, vd: Any) -> tuple[Any, Any]:
        """q and v at the end of the step for accelerations v1'."""
        return equations.advance(self.T, x.q, combine(known.q, w.scale, vd)), combine(known.v, w.rate, vd)

    def residual(self, w: Weights, data: equations.Data, x: State, z: Any, drives: list) -> Any:
        """R [n_v + rows, ...] of the unknowns z."""
        T = self.T
        vd, lam = z[: T.n_v], z[T.n_v :]
        q, v = self._end(w, x, self._known(w, x), vd)
        at = equations.placement(T, data, q, drives)
        forces = equations.dynamic_residual(T, data, at, v, vd, lam)
        return cat([forces, equations.constraints(T, at) * w.inverse_scale]) if T.rows else forces

    def correct(
        self, w: Weights, data: equations.Data, x: State, H: Tensor, z: Tensor, drives: list
    ) -> tuple[Tensor, Tensor]:
        """Corrected unknowns and the correction."""
        correction = apply(H, self.residual(w, plain(data), x.values(), z, drives))
        return z - correction, correction

    def matrix(self, w: Weights, data: equations.Data, x: State, z: Tensor, drives: list) -> Tensor:
        """Iteration matrix [lanes, n, n]."""
        T, data, x = self.T, plain(data), x.values()
        q, v = self._end(w, x, self._known(w, x), z[: T.n_v])
        K = self.saddle.matrix(data, equations.placement(T, data, q, drives), w.scale, w.rate, v, z[: T.n_v], z[T.n_v :])
        # A change of the increment turns the body by d(exp), not by the change itself: to first order 1 - h ~om / 2.
        turns = K[:, T.n_v :, 3 * T.bodies : 6 * T.bodies].unflatten(2, (3, T.bodies))
        spin = equations.split_v(T, v)[1][:, :, 0].permute(2, 0, 1)[:, None].expand_as(turns)
        turns -= w.half * torch.linalg.cross(turns, spin, dim=2)
        return K

    def tangent_first(
        self, w: Weights, data: equations.Data, x: State, H: Tensor, z: Tensor, drives: list
    ) -> tuple[Tensor, Tensor, Tensor]:
        """R by everything, the correction, and the tangents dz, all [n, n_b, lanes]; dz starts from the last step's."""
        start = cat([x.vd, x.lam]).tangent
        R = self.residual(w, data, x, Pair.of(z, start), drives).tangent
        correction = apply(H, R)
        return R, correction, start - correction

    def tangent_next(
        self,
        w: Weights,
        data: equations.Data,
        x: State,
        H: Tensor,
        z: Tensor,
        drives: list,
        R: Tensor,
        correction: Tensor,
        dz: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same after another correction."""
        R = R - self.residual(w, plain(data), x.values(), Pair.of(z, correction), drives).tangent
        correction = apply(H, R)
        return R, correction, dz - correction

    def finish(self, w: Weights, x: State, z: Any) -> State:
        """The new state."""
        vd, lam = z[: self.T.n_v], z[self.T.n_v :]
        known = self._known(w, x)
        q, v = self._end(w, x, known, vd)
        return State(q, v, vd, combine(known.a, w.share, vd), lam)


def plain(data: equations.Data) -> equations.Data:
    """The values of data."""
    return {name: value(y) for name, y in data.items()}


def inverse(K: Tensor) -> Tensor:
    """Inverses of matrices [lanes, n, n]. A lane whose matrix is singular becomes nan, alone."""
    H, info = torch.linalg.inv_ex(K)
    return torch.where((info == 0)[:, None, None], H, torch.nan)


def apply(H: Tensor, R: Tensor) -> Tensor:
    """Multiply right-hand sides [n, slots, lanes] by matrices [lanes, n, n]."""
    return torch.bmm(H, R.permute(2, 0, 1)).permute(1, 2, 0)
