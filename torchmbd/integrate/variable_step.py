"""Steps whose size depends on the design, and the state a little after a switch.

Size h and end t1 of a step are numbers [1 + n, 1] with tangents; one lane. Iterated to rounding, values and tangents.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py, tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.step import Model, Step, Weights, apply
from torchmbd.math.jet import Jet
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.elimination import Factored, factored
from torchmbd.multibody.system.topology import Prescribed, Topology
from torchmbd.results.state import State

_MOST = 25  # corrections
_ROUNDING = 1e-13  # relative


def step_of_size(dynamics: Dynamics, weights: Callable[[Any], Weights], x: State, h: Any, t1: Any) -> State:
    """The state of one lane after a step of size h that ends at t1; numbers [1 + n, 1], pairs if x are.

    weights   of a step, as a function of its size

    In grad mode differentiable in reverse mode by all that it depends on.
    """
    model = Model(dynamics.topology, dynamics.saddle, weights(h), dynamics.data)
    step = model.step(x, prescribed_at(dynamics.topology, t1, dynamics.data))
    with torch.no_grad():
        z, K = _solved(dynamics, step, torch.cat([value(x.vd), value(x.lam)]))
    if isinstance(x.q, Pair):
        return step.finish(z, converged(step, factored(K), z, torch.cat([x.vd.tangent, x.lam.tangent])))
    return step.finish(_implicit(step, factored(K.mT), z) if torch.is_grad_enabled() else z)


def _solved(dynamics: Dynamics, step: Step, z: Tensor) -> tuple[Tensor, Tensor]:
    """The unknowns z [n, 1, 1] of a step from an estimate, and the iteration matrix there."""
    before = torch.inf
    for _ in range(_MOST):
        K = dynamics.regularize(step.matrix(z))
        z, correction = step.correct(factored(K), z)
        size = float(step.size(correction))
        if _done(size, before, z):
            break
        before = size
    return z, K


def converged(step: Step, H: Factored, z: Tensor, dz: Tensor) -> Tensor:
    """Tangents [n, pair, lanes] of the unknowns z of a step, iterated to rounding from an estimate."""
    before = torch.inf
    for _ in range(_MOST):
        dz, correction = step.tangent(H, z, dz)
        size = float(step.size(correction).max())
        if _done(size, before, dz):
            break
        before = size
    return dz


def _implicit(step: Step, H: Factored, z: Tensor) -> Tensor:
    """The unknowns as a function of all that their residual R(z; ...) depends on, for reverse mode; H: of the transpose.

    dz = -R_z^-1 dR:  the cotangent of R is -mu with R_z' mu = the cotangent of z.
    """
    leaf = z.detach().requires_grad_()
    residual = step.residual(leaf)

    def solved(goal: Tensor) -> Tensor:
        mu, before = apply(H, goal), torch.inf
        for _ in range(_MOST):
            (pulled,) = torch.autograd.grad(residual, leaf, mu, retain_graph=True)
            correction = apply(H, pulled - goal)
            mu = mu - correction
            size = float(step.size(correction))
            if _done(size, before, mu[: step.model.T.n_v]):
                break
            before = size
        return mu

    found = z - (residual - residual.detach())
    found.register_hook(solved)
    return found


def _done(size: float, before: float, z: Tensor) -> bool:
    """Whether a correction was rounding only: tiny, or no smaller than half the one before once these are small."""
    scale = float(z.abs().max()) if z.numel() else 0.0
    return not size > _ROUNDING * scale or (size > 0.5 * before and size < 1e-6 * scale)


def prescribed_at(T: Topology, t: Any, data: equations.Data) -> Prescribed:
    """Drives and bodies of known motion at a time t [1 + n, 1], with tangents if t has any."""
    prescribed = T.prescribed(value(t)[0, 0], data)
    if not isinstance(t, Pair):
        return prescribed
    laws = [None if law is None else tuple(_at(x, t) for x in law) for law in T.law_jets(value(t)[0, 0], data)]
    return prescribed._replace(laws=laws, t=t)


def least_norm_multipliers(dynamics: Dynamics, t: Any, x: State) -> Any:
    """Multipliers of a state at a time t [1 + n, 1], of redundant rows those of least norm."""
    least = dynamics.least_norm
    return (
        x.lam if least is None else least(dynamics.data, prescribed_at(dynamics.topology, t, dynamics.data), x.q, x.lam)
    )


def _at(x: Jet, t: Pair) -> Pair:
    """What a law prescribes at a time that depends on the design."""
    moved = value(x.velocity) * t.tangent
    return Pair.of(value(x.value), moved + x.value.tangent if isinstance(x.value, Pair) else moved)


def shortly_after(T: Topology, x: State, h: Any) -> State:
    """The state a short time h [1 + n, 1] later: the first terms of the Taylor series."""
    q = equations.advance(T, x.q, h * x.v + (0.5 * h * h) * x.vd)
    return x._replace(q=q, v=x.v + h * x.vd)


def widened(x: Any, extra: int = 1) -> Any:
    """A number as a pair with further directions in which it does not change."""
    if isinstance(x, Pair):
        return Pair.of(x.value, torch.cat([x.tangent, x.full.new_zeros(*x.shape[:-2], extra, x.shape[-1])], -2))
    return Pair.of(x, x.new_zeros(*x.shape[:-2], extra, x.shape[-1]))


def widened_data(dynamics: Dynamics) -> Dynamics:
    """The dynamics with one more direction of the tangents of its data."""
    return replace(dynamics, data={k: widened(x) if isinstance(x, Pair) else x for k, x in dynamics.data.items()})


def narrowed(x: Any, slope: Any) -> Any:
    """The number as a function of the design alone, with the last direction's variable a function of slope [n] of it."""
    if not len(slope):
        return x.value
    return Pair.of(x.value, x.tangent[..., :-1, :] + x.tangent[..., -1:, :] * slope[:, None])
