"""The derivative of a motion by equal steps by its duration T: that of the discrete map, whose steps are T/n long.

    h = T / n,   t_i = i T / n          dh/dT = 1/n,   dt_i/dT = i/n

The size of a step enters the weights of the method; the time enters drives, bodies of known motion and forces that depend
on it. One tangent is carried along the states that were recorded, by the eager operations of a step (step.py),
iterated to rounding. With it both modes are a product: one number T moves all outputs.
Checked in tests/integrate/test_duration.py.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from torchmbd.integrate.adjoint import Grid
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.step import Model, Weights
from torchmbd.integrate.variable_step import converged
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.elimination import factored
from torchmbd.multibody.system.saddle_factors import regularized
from torchmbd.multibody.system.topology import Prescribed
from torchmbd.results.history import History
from torchmbd.results.state import State


@torch.no_grad()
def tangents(grids: Iterable[Grid], integrator: OneStep, history: History) -> tuple[list[Tensor], list[Tensor]]:
    """Of q, v, v' and lam [times, n, 1, lanes], and of these at the steps (`History.at_steps`); zero in lanes of no grid."""
    at_times, at_steps = (
        [torch.zeros_like(x[:, :, :1]) for x in states] for states in (history.states, history.at_steps())
    )
    for grid in grids:
        for k, x in enumerate(_of_grid(grid, integrator)):
            kept = x[:: grid.every]
            at_times[k][..., grid.lanes] = kept[:: grid.substeps]
            if at_steps:
                at_steps[k][: len(kept), ..., grid.lanes] = kept
    return at_times, at_steps


def _of_grid(grid: Grid, integrator: OneStep) -> list[Tensor]:
    n = len(grid.times) - 1
    h = float(grid.times[-1]) / n
    w = integrator.weights(Pair(torch.tensor([[h], [1.0 / n]], dtype=torch.float64)))
    dynamics, diagonal = grid.dynamics, grid.dynamics.diagonal()
    model = Model.of(dynamics, w)
    x = grid.start.map(lambda y: _still(value(y).detach(), len(grid.lanes)))
    states, schedule = [x], _schedule(dynamics, grid.times)
    for i, prescribed in enumerate(schedule):
        z = torch.cat([grid.history.vd[i + 1], grid.history.lam[i + 1]])
        step = model.step(x, prescribed)
        H = factored(regularized(step.matrix(z), diagonal))
        dz = converged(step, H, z, torch.cat([x.vd.tangent, x.lam.tangent]))
        x = _recorded(step.finish(z, dz), grid, i + 1, w.values())
        states.append(x)
    return [torch.stack([getattr(x, name).tangent for x in states]) for name in ("q", "v", "vd", "lam")]


def _still(x: Tensor, lanes: int) -> Pair:
    wide = x.expand(*x.shape[:-1], lanes)
    return Pair.of(wide, torch.zeros_like(wide))


def _recorded(x: State, grid: Grid, i: int, w: Weights) -> State:
    """The state with its values as they were recorded: no rounding adds up. The algorithmic acceleration is not recorded."""
    h = grid.history
    own = (h.q[i], h.v[i], h.vd[i], value(x.a), h.lam[i])
    return State(*(Pair.of(y, z.tangent) for y, z in zip(own, x, strict=True)))


def _schedule(dynamics: Dynamics, times: Tensor) -> list[Prescribed]:
    """Drives and bodies of known motion at all times but the first, with their derivatives by the duration."""
    T, share = dynamics.topology, torch.linspace(0.0, 1.0, len(times), dtype=torch.float64)[1:]

    def numbers(t: Tensor) -> list[Tensor]:
        rows = [(x.A, x.r, *(part for law in x.laws for part in law or ())) for x in T.schedule(t, dynamics.data)]
        return [torch.stack(part) for part in zip(*rows, strict=True)]

    found = [Pair.of(x, dx) for x, dx in zip(*torch.func.jvp(numbers, (times[1:],), (share,)), strict=True)]
    result = []
    for i, prescribed in enumerate(T.schedule(times[1:], dynamics.data)):
        A, r, *rest = (Pair(x.full[i]) for x in found)
        parts = iter(rest)
        laws = [None if law is None else tuple(next(parts) for _ in law) for law in prescribed.laws]
        t = Pair(torch.stack([times[i + 1], share[i]])[:, None])
        result.append(Prescribed(laws, A, r, t))  # pyright: ignore[reportArgumentType]
    return result
