"""The pullback of a one-step method's step (step.py): cotangents of the state after it give those of all it depends on.

z the unknowns of the step, x1 = F(z, x) the state after it, R(z; x, b) = 0 its equations, y the cotangent of x1:

    R_z' mu = F_z' y        y_x = F_x' y - R_x' mu        y_b = -R_b' mu

It is the transpose of the tangents of the discrete step. mu comes from the factors of the iteration matrix, transposed and at
the solution itself, with corrections until they are small.
Checked in tests/sensitivity/test_adjoint.py, tests/contracts/test_integrators.py.
Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, chapter 15 (implicit functions).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.step import Model, Step
from torchmbd.math.pair import apply, value
from torchmbd.multibody.equations.topology import Prescribed
from torchmbd.results.state import State

MOST = 12  # corrections of mu
NEGLIGIBLE = 1e-9  # of the accelerations that tangents of multipliers could cause: no tangents at all
ENOUGH = 1e-8  # estimated relative error of mu that gets no other correction; most steps have it after the first


class PulledBack(NamedTuple):
    """Cotangents [..., rows, lanes] of the state before a step, of data and of laws with design variables, by name.

    error   estimated relative error [lanes]
    """

    state: State
    data: dict[str, Tensor]
    laws: dict[str, Tensor]
    error: Tensor


class StepPullback:
    """Of one step from a state to another."""

    def __init__(self, model: Model, before: State, after: State, prescribed: Prescribed, corrections: int):
        T, self.corrections = model.T, corrections
        varied: dict[int, tuple] = {i: prescribed.laws[i] or () for i in T.varying_primitives}
        self.laws = {f"{i}.{k}": x for i, law in varied.items() for k, x in enumerate(law)}
        self.x, self.z = before.map(leaf), leaf(torch.cat([after.vd, after.lam]))
        lanes = self.z.shape[-1]
        self.law_values = {name: leaf(value(x).expand(*x.shape[:-2], 1, lanes)) for name, x in self.laws.items()}
        laws: list = [
            tuple(self.law_values[f"{i}.{k}"] for k in range(len(law or ()))) if i in varied else law
            for i, law in enumerate(prescribed.laws)
        ]
        self.data = model.data
        with torch.enable_grad():
            self.step = step = Step(model, self.x, Prescribed(laws, *prescribed[1:]))
            self.end, self.residual = step.finish(self.z), step.residual(self.z)
        with torch.no_grad():
            self.matrix = step.matrix(self.z)

    def __call__(self, y: State, factors: Callable[[Tensor], Any]) -> PulledBack:
        """What follows from cotangents y [n, rows, lanes] of the state after the step; factors: of the transposed matrix."""
        H, rows = factors(self.matrix), range(y.q.shape[1])
        parts = [self._row(H, y.map(lambda x, row=row: x[:, row : row + 1])) for row in rows]
        states, data, laws, errors = (list(x) for x in zip(*parts, strict=True))
        before = State(*(torch.cat(x, 1) for x in zip(*states, strict=True)))
        by_data, by_laws = ({k: torch.cat([x[k] for x in some], -2) for k in some[0]} for some in (data, laws))
        return PulledBack(before, by_data, by_laws, torch.stack(errors).amax(0))

    def _row(self, H: Any, y: State) -> PulledBack:
        goal, *known = _pulled(self.end, y, [self.z, *self.x])
        mu, error = self._solved(H, goal)
        names, law_names = list(self.data), list(self.law_values)
        leaves = [*self.x, *self.data.values(), *self.law_values.values()]
        by = [-x for x in _pulled([self.residual], [mu], leaves)]
        n = len(known)
        state = State(*(a + b for a, b in zip(known, by[:n], strict=True)))
        data = dict(zip(names, by[n : n + len(names)], strict=True))
        return PulledBack(state, data, dict(zip(law_names, by[n + len(names) :], strict=True)), error)

    def _solved(self, H: Any, goal: Tensor) -> tuple[Tensor, Tensor]:
        """mu [n, 1, lanes] with R_z' mu = goal, and its estimated relative error [lanes]."""
        mu = apply(H, goal)
        active = error = before = torch.ones_like(goal[0, 0])
        for k in range(1, max(MOST, self.corrections) + 1):
            (pulled,) = _pulled([self.residual], [mu], [self.z])
            correction = apply(H, pulled - goal)
            mu = mu - active * correction
            # Where mu of accelerations is rounding only, what mu of multipliers would make of it.
            size = self.step.size(mu).maximum(NEGLIGIBLE * self.step.size_of_multipliers(mu))[0]
            change = self.step.size(correction)[0] / size.clamp_min(torch.finfo(mu.dtype).tiny)
            # Each correction leaves the same share of what the one before left.
            error = torch.where(active > 0.0, change * change / before, error)
            before = change.clamp_min(torch.finfo(mu.dtype).tiny)
            if k >= self.corrections:
                active = active * (error > ENOUGH)  # what a lane gets depends on no other
            if not bool(active.any()):
                break
        return mu, error


def leaf(x: Tensor) -> Tensor:
    return x.detach().clone().requires_grad_()


def _pulled(outputs: Sequence[Tensor], weights: Sequence[Tensor], by: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Derivatives of sum(weights * outputs); zeros where there are none."""
    of, by_weights = zip(*((x, w) for x, w in zip(outputs, weights, strict=True) if x.requires_grad), strict=True)
    return torch.autograd.grad(of, by, by_weights, retain_graph=True, allow_unused=True, materialize_grads=True)
