"""One step on the index-3 equations: the operations that one-step integrators are made of (see one_step.py).

Each is a pure function of tensors: no branch on numbers, nothing kept. A backend may trace them,
so that eager and compiled steps have one source.

    correct   z <- z - H R(z)                              values
    matrix    dR/dz                                        values
    tangent   dz <- dz - H (R_z dz + R_x dx + R_b)         all tangents of state and data
    finish    the new state of converged unknowns          values and tangents

x is the state at the start of the step, z = (v1', lam) the unknowns [n, 1, lanes], H the inverse of a matrix, as factors.
The matrix is exact but for second derivatives of constraints other than coinciding points, so that one tangent
correction is mostly enough.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.elementwise import reciprocal
from torchmbd.math.pair import Pair, apply, cat, combine, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.topology import Prescribed, Topology
from torchmbd.multibody.saddle.blocks import Slopes
from torchmbd.multibody.saddle.elimination import Eliminated, Factored
from torchmbd.multibody.saddle.matrix import Saddle
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


class Weights(NamedTuple):
    """Numbers of one method and step size.

    Floats; tensors without axes for a compiled step; pairs [1 + n_b, 1] for a step whose size depends on the design.
    """

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

    @classmethod
    def newmark(cls, h: Any, am: float, af: float) -> Weights:
        """Of Newmark's updates with weighted accelerations, of second order:

            (1 - am) a1 + am a0 = (1 - af) v1' + af v0',    gamma = 1/2 + af - am,    beta = (gamma + 1/2)^2 / 4

        h   a float, or a number [1, 1] that may be a pair (variable_step.py)
        """
        share, gamma = (1.0 - af) / (1.0 - am), 0.5 + af - am
        new = 0.25 * (gamma + 0.5) ** 2
        scale = new * h * h * share
        return cls(
            share=share,
            a_from_vd=af / (1.0 - am),
            a_from_a=-am / (1.0 - am),
            h=h,
            step_from_a=h * h * (0.5 - new),
            step_from_new=h * h * new,
            v_from_a=h * (1.0 - gamma),
            v_from_new=h * gamma,
            scale=scale,
            rate=gamma * h * share,
            inverse_scale=reciprocal(scale),
        )

    def values(self) -> Weights:
        return Weights(*(value(x) for x in self))


class Step:
    """A step from the state x to a time with `prescribed` drives and bodies of known motion.

    Where the size or the end of the step depends on the design, the weights and `prescribed` are pairs.
    """

    def __init__(self, model: Model, x: State, prescribed: Prescribed):
        self.model, self.x, self.prescribed = model, x, prescribed
        self._prescribed_values = prescribed.values()
        self._predicted_values = self._predict(x.values(), model.plain)

    @cached_property
    def _predicted(self) -> State:
        return self._predict(self.x, self.model.w)

    @staticmethod
    def _predict(x: State, w: Weights) -> State:
        """The share of the state x in q (as an increment), v and a at the end of the step; that of z is added."""
        a = combine(w.a_from_vd * x.vd, w.a_from_a, x.a)
        step = combine(combine(w.h * x.v, w.step_from_a, x.a), w.step_from_new, a)
        v = combine(combine(x.v, w.v_from_a, x.a), w.v_from_new, a)
        return State(step, v, x.vd, a, x.lam)

    def residual(self, z: Any) -> Any:
        """R [n_v + rows, ...] of the unknowns z."""
        T, w, _, _, _, data = self._inputs(isinstance(z, Pair))
        at, v = self._end(z)
        forces = equations.dynamic_residual(T, data, at, v, z[: T.n_v], z[T.n_v :])
        return cat([forces, equations.constraints(T, at) * w.inverse_scale]) if T.rows else forces

    def action_states(self, z: Any) -> list[tuple]:
        """s, s' [n, ...] and direction of each kind of action at the end of the step."""
        at, v = self._end(z)
        return equations.action_states(self.model.T, self._inputs(isinstance(z, Pair))[-1], at, v)

    def _end(self, z: Any) -> tuple[equations.Placement, Any]:
        """Positions and rates at the end of the step."""
        T, w, q0, predicted, prescribed, data = self._inputs(isinstance(z, Pair))
        vd = z[: T.n_v]
        q = equations.advance(T, q0, combine(predicted.q, w.scale, vd))
        return equations.placement(T, data, q, prescribed), combine(predicted.v, w.rate, vd)

    def _inputs(self, tangents: bool) -> tuple:
        """Topology, weights, q, predicted state, prescribed motion and data, as pairs or as values."""
        m = self.model
        if tangents:
            return m.T, m.w, self.x.q, self._predicted, self.prescribed, m.data
        return m.T, m.plain, value(self.x.q), self._predicted_values, self._prescribed_values, m.values

    def uniform(self) -> Any:
        """Unknowns of a uniform motion, q1 = q0 o exp(h v0), with the multipliers of before: a start for the iteration.

        The accelerations of the state say nothing of the step where they last for much less than it, as those of a node of a
        beam that has just been let go: h^2 v' would be many times its elements.
        """
        w, x = self.model.plain, self.x.values()
        return cat([(w.h * x.v - self._predicted_values.q) * w.inverse_scale, x.lam])

    def correct(self, H: Factored | Eliminated, z: Tensor) -> tuple[Tensor, Tensor]:
        """Corrected unknowns, and their correction [n, 1, lanes]."""
        correction = apply(H, self.residual(z))
        return z - correction, correction

    def matrix(self, z: Tensor) -> Tensor:
        """Iteration matrix [lanes, n, n]."""
        T, w, q0, predicted, prescribed, data = self._inputs(False)
        vd, lam = z[: T.n_v], z[T.n_v :]
        step = combine(predicted.q, w.scale, vd)
        at = equations.placement(T, data, equations.advance(T, q0, step), prescribed)
        turn, v = equations.split_v(T, step)[1], combine(predicted.v, w.rate, vd)
        return self.model.saddle.matrix(data, at, Slopes(w.scale, w.rate, v, vd, lam, turn))

    def tangent(self, H: Factored | Eliminated, z: Tensor, dz: Tensor) -> tuple[Tensor, Tensor]:
        """Corrected design tangents [n, n_b, lanes] of the unknowns, and their correction."""
        correction = apply(H, self.residual(Pair.of(z, dz)).tangent)
        return dz - correction, correction

    def size(self, correction: Tensor) -> Tensor:
        """Size of a correction of the accelerations [1 + n_b, lanes] [1/s2]."""
        n_v = self.model.T.n_v
        return (correction[:n_v].abs() / self.model.sizes[:n_v, None]).amax(0)

    def size_of_multipliers(self, z: Tensor) -> Tensor:
        """Size of the multipliers among unknowns z, or among their cotangents [1 + n_b, lanes]: the acceleration of the
        heaviest body by them [1/s2]; zero of none."""
        n_v, none = self.model.T.n_v, torch.zeros_like(z[:1])
        sizes = torch.cat([self.model.sizes[n_v:], self.model.sizes[:1]])
        return (torch.cat([z[n_v:], none]).abs() / sizes[:, None]).amax(0)

    def finish(self, z: Tensor, dz: Tensor | None = None) -> State:
        """The new state."""
        both = z if dz is None else Pair.of(z, dz)
        T, w, q0, predicted, _, _ = self._inputs(dz is not None)
        vd, lam = both[: T.n_v], both[T.n_v :]
        q = equations.advance(T, q0, combine(predicted.q, w.scale, vd))
        return State(q, combine(predicted.v, w.rate, vd), vd, combine(predicted.a, w.share, vd), lam)


class Model:
    """Equations, weights and data that all steps of a simulation share; a backend may trace its steps.

    sizes   of accelerations and multipliers [n_v + rows, lanes or 1] (sizes.py): by these iterations compare them
    """

    def __init__(self, T: Topology, saddle: Saddle, w: Weights, data: Data, sizes: Tensor):
        self.T, self.saddle, self.w, self.data, self.sizes = T, saddle, w, data, sizes
        self.plain = w.values()
        self.values = {name: value(y) for name, y in data.items()}

    @classmethod
    def of(cls, dynamics: Dynamics, w: Weights) -> Model:
        """The model of a simulation."""
        return cls(dynamics.topology, dynamics.saddle, w, dynamics.data, dynamics.sizes.unknowns)

    def step(self, x: State, prescribed: Prescribed) -> Step:
        """The step from x."""
        return Step(self, x, prescribed)


def algorithmic(w: Weights, a: Any, vd: Tensor) -> Any:
    """The algorithmic acceleration after k steps, from that before them and true ones vd [k + 1, n_v, pair, lanes].

        a1 = w (v0', v1') + c a0        so        a_k = c^k a0 + sum_i c^(k - i) (...)

    The weights of accelerations do not depend on the size of a step, and |c| is one at most.
    """
    powers = w.a_from_a ** torch.arange(len(vd) - 1, -1, -1, dtype=torch.float64)
    of_vd = w.share * powers
    of_vd[0] = 0.0
    of_vd[:-1] += w.a_from_vd * powers[1:]
    total = torch.tensordot(of_vd, vd, 1)
    return combine(Pair(total) if vd.shape[-2] > 1 else total, float(powers[0]), a)
