"""Steps whose size depends on the design, and the state a little after a switch.

Size h and end t1 of a step are numbers [1 + n, lanes] with tangents: each lane has its own, and its numbers depend on no
other lane. Iterated to rounding, values and tangents; a lane whose iteration does not converge is nan.
`MovingSteps` are regular steps whose size moves with the duration T of the motion: h = T / n, t_i = i T / n.
Checked in tests/integrate/phases/test_variable_step.py, tests/sensitivity/test_events.py,
tests/sensitivity/test_phase_adjoint.py, tests/sensitivity/test_phase_times.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.integrator import Stepper
from torchmbd.integrate.step import Model, Step, Weights, algorithmic
from torchmbd.math.pair import Pair, apply, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.times_as_lanes import at_own_times
from torchmbd.multibody.equations.topology import Schedule, Topology
from torchmbd.multibody.saddle.elimination import Factored, factored
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import Record
from torchmbd.results.state import State

_MOST = 40  # corrections
_ROUNDING = 1e-13  # relative
_STALLED = 1e-6  # relative: a correction below it that is not half of the one before is rounding
_QUADRATIC = 1e-8  # relative: a correction with a new matrix that is below it leaves rounding
_NEAR = 1e-3  # relative: after a correction below it the matrix is kept, which then leaves about this share of an error
_SLOW = 0.1  # of the correction before: a larger one calls for a new matrix
_TINY = torch.finfo(torch.float64).tiny
_EPSILON = 1e-14  # rounding of coordinates, with what equations and factors add to it


def step_of_size(
    dynamics: Dynamics, weights: Callable[[Any], Weights], x: State, h: Any, t1: Any, near: State | None = None
) -> State:
    """The state of all lanes after steps of sizes h that end at t1; numbers [1 + n, lanes], pairs if x are.

    weights   of a step, as a function of its size
    near      a state whose accelerations and multipliers are near those at the end; None: those of x

    A lane whose step does not converge is nan.
    """
    step = _step(dynamics, weights, x, h, t1)
    start = x if near is None else near
    with torch.no_grad():
        z = _solved(dynamics, step, None if near is None else torch.cat([value(near.vd), value(near.lam)]).detach())
        if not isinstance(x.q, Pair):
            return step.finish(z)
        K = dynamics.regularize(step.matrix(z))
    like = start if isinstance(start.vd, Pair) else x
    return step.finish(z, converged(step, factored(K), z, torch.cat([like.vd.tangent, like.lam.tangent])))


def step_to(dynamics: Dynamics, weights: Callable[[Any], Weights], x: State, h: Any, t1: Any, end: State) -> State:
    """The state `end` of all lanes after steps that `step_of_size` made, as a function of all that it depends on; tensors.

    Differentiable in reverse mode, in grad mode.
    """
    step, z = _step(dynamics, weights, x, h, t1), torch.cat([end.vd, end.lam]).detach()
    with torch.no_grad():
        K = dynamics.regularize(step.matrix(z))
    return step.finish(_implicit(step, factored(K.mT), z))


class MovingSteps(Stepper):
    """Steps of an integrator whose sizes depend on the design; time(k): that of point k of the grid [1 + n, lanes]."""

    def __init__(self, integrator: Any, dynamics: Dynamics, time: Callable[[int], Any]):
        super().__init__(dynamics)
        self.integrator, self.time = integrator, time

    def run(self, x: State, schedule: Schedule, record: Record, first: int = 0, start: int = 1) -> State:
        """See Stepper. The schedule counts steps only: laws are evaluated at times that depend on the design."""
        self.steps = len(schedule)  # the last ones
        for k in range(len(schedule)):
            begin, end = self.time(first + k), self.time(first + k + 1)
            x = self.integrator.step_of_size(self.dynamics, x, end - begin, end)
            record.put(start + k, x)
        return x

    def algorithmic(self, a: Any, vd: Tensor) -> Any:
        return algorithmic(self.integrator.weights(1.0), a, vd)


def _step(dynamics: Dynamics, weights: Callable[[Any], Weights], x: State, h: Any, t1: Any) -> Step:
    model = Model.of(dynamics, weights(h))
    return model.step(x, at_own_times(dynamics.topology, t1, dynamics.data))


def _solved(dynamics: Dynamics, step: Step, estimate: Tensor | None) -> Tensor:
    """The unknowns z [n, 1, lanes] of a step; nan where none converge.

    By the backend, or from an estimate; where that does not lead there, from a uniform motion (`Step.uniform`), then from
    none at all.
    """
    uniform = step.uniform().detach()
    z, success = torch.full_like(uniform, torch.nan), torch.zeros(uniform.shape[-1], dtype=torch.bool)
    if (solution := backend_of(dynamics).unknowns(dynamics, step)) is not None:
        z, (before, last) = solution
        scale, rounding = _largest(step, z, None), _rounding(dynamics, step)
        small = (last <= _STALLED * scale) | (last <= rounding)
        success = small & ((last <= _ROUNDING * scale) | (before <= _QUADRATIC * scale) | (before <= rounding))
    for start in ([] if estimate is None else [estimate]) + [uniform, torch.zeros_like(uniform)]:
        if bool(success.all()):
            break
        other, others = _from(dynamics, step, start)
        z, success = torch.where(success, z, other), success | others
    return torch.where(success, z, torch.nan)


def _rounding(dynamics: Dynamics, step: Step) -> Tensor:
    """Size [lanes] of corrections of a system at rest: what the rounding of coordinates makes of its accelerations."""
    return _EPSILON * (value(step.x.q)[:, 0].abs() / dynamics.sizes.q).amax(0) * step.model.plain.inverse_scale[0]


def _from(dynamics: Dynamics, step: Step, estimate: Tensor) -> tuple[Tensor, Tensor]:
    """The unknowns that operators of torch find from one estimate, and which lanes converged."""
    K: Any = None
    H: Any = None
    size = torch.full((estimate.shape[-1],), torch.inf, dtype=torch.float64)

    def correction(z: Tensor, active: Tensor) -> Tensor:
        nonlocal K, H, size
        if bool((active & (size > _NEAR)).any()):  # a lane that is near keeps its matrix
            at_z = dynamics.regularize(step.matrix(z))
            K = at_z if K is None else torch.where((active & (size > _NEAR))[:, None, None], at_z, K)
            H = factored(K)
        change = step.correct(H, z)[1]
        before, size = size, _largest(step, change, step.model.T.n_v) / _largest(step, z, None).clamp_min(_TINY)
        size = torch.where(size > _SLOW * before, torch.inf, size)
        return change

    return _iterated(step, correction, estimate, _rounding(dynamics, step))


def converged(step: Step, H: Factored, z: Tensor, dz: Tensor) -> Tensor:
    """Tangents [n, pair, lanes] of the unknowns z of a step, iterated to rounding from an estimate."""
    return _iterated(step, lambda dz, _: step.tangent(H, z, dz)[1], dz)[0]


def _implicit(step: Step, H: Factored, z: Tensor) -> Tensor:
    """The unknowns as a function of all that their residual R(z; ...) depends on, for reverse mode; H: of the transpose.

    dz = -R_z^-1 dR:  the cotangent of R is -mu with R_z' mu = the cotangent of z.
    """
    leaf = z.detach().requires_grad_()
    residual = step.residual(leaf)

    def solved(goal: Tensor) -> Tensor:
        def correction(mu: Tensor, _: Tensor) -> Tensor:
            (pulled,) = torch.autograd.grad(residual, leaf, mu, retain_graph=True)
            return apply(H, pulled - goal)

        return _iterated(step, correction, apply(H, goal), of=step.model.T.n_v)[0]

    result = z - (residual - residual.detach())
    result.register_hook(solved)
    return result


def _iterated(
    step: Step,
    correction: Callable[[Tensor, Tensor], Tensor],
    x: Tensor,
    rounding: Any = 0.0,
    of: int | None = None,
) -> tuple[Tensor, Tensor]:
    """x [n, pair, lanes] less its corrections until those of accelerations are rounding, and which lanes got there.

    correction(x, active)   of the lanes that still change
    rounding                size of a correction that is rounding whatever x is [lanes] [1/s2]
    of                      how many rows of x are a measure of the others; None: all
    """
    active = torch.ones(x.shape[-1], dtype=torch.bool)
    success, before = ~active, torch.full((x.shape[-1],), torch.inf, dtype=torch.float64)
    for _ in range(_MOST):
        change = correction(x, active)
        x = torch.where(active, x - change, x)
        size, scale = _largest(step, change, step.model.T.n_v), _largest(step, x, of)
        small = (size <= _STALLED * scale) | (size <= rounding)
        # Near the end each correction leaves the same share of what the one before left: the next would be size^2 / before.
        predicted = (size * size <= _ROUNDING * scale * before) & (before <= _NEAR * scale)
        last = (size <= _ROUNDING * scale) | predicted
        done = last | (small & (size > 0.5 * before))
        success = torch.where(active, small | last, success)
        active = active & ~done & torch.isfinite(size)
        if not bool(active.any()):
            break
        before = size
    return x, success


def _largest(step: Step, x: Tensor, rows: int | None) -> Tensor:
    """Largest of the first rows of unknowns x [n, pair, lanes] by their sizes, in each lane."""
    return (x[:rows].abs() / step.model.sizes[:rows, None]).flatten(0, 1).amax(0)


def shortly_after(T: Topology, x: State, h: Any) -> State:
    """The state a short time h [1 + n, lanes] later: the first terms of the Taylor series."""
    q = equations.advance(T, x.q, h * x.v + (0.5 * h * h) * x.vd)
    return x._replace(q=q, v=x.v + h * x.vd)


def on_the_way(x: State, end: State, share: Any) -> State:
    """The state x with accelerations and multipliers of a share [1 + n, lanes] of the way to those of the state `end`."""
    return x._replace(vd=x.vd + share * (end.vd - x.vd), lam=x.lam + share * (end.lam - x.lam))


def widened(x: Any, extra: int = 1) -> Any:
    """A number as a pair with further directions in which it does not change."""
    if isinstance(x, Pair):
        return Pair.of(x.value, torch.cat([x.tangent, x.full.new_zeros(*x.shape[:-2], extra, x.shape[-1])], -2))
    return Pair.of(x, x.new_zeros(*x.shape[:-2], extra, x.shape[-1]))


def widened_data(dynamics: Dynamics) -> Dynamics:
    """The dynamics with one more direction of the tangents of its data."""
    return dynamics.with_data({k: widened(x) if isinstance(x, Pair) else x for k, x in dynamics.data.items()})


def narrowed(x: Any, slope: Tensor) -> Any:
    """The number as a function of the design alone, with the last direction's variable a function of slope [n, lanes] of it."""
    return Pair.of(x.value, x.tangent[..., :-1, :] + x.tangent[..., -1:, :] * slope)
