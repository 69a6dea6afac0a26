"""Design gradients of functions of a motion, along its first-order neighbors (Trajectory.moved); eq. (27).

    df/db = d/d(delta) f(motion.moved(delta))  at delta = 0

Forward or reverse mode, whichever has fewer columns. Checked in tests/contracts/test_responses.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrators import Trajectory
from torchmbd.integrators.adjoint import Adjoint


ROWS = 16  # that go back together: their derivatives by a whole motion are all in memory


class Valued(NamedTuple):
    """A value with its design gradient; None for a motion without sensitivities."""

    value: Tensor
    gradient: Tensor | None


def differentiate(f: Callable[[Any], Tensor], motion: Trajectory) -> Valued:
    """f(motion) [lanes, ...] with its gradient [lanes, ..., n_b].

    In reverse mode where f has no more numbers than there are design variables, else in forward mode. Lanes know nothing of
    each other: the gradient of a sum over lanes by the neighbor of each lane is that of each.
    """
    shared = replace(motion, known={})  # what measures share lives as long as this
    n = len(motion.parameters)
    if not n:
        return Valued(f(shared), None)
    with torch.inference_mode(False), torch.enable_grad():  # wherever the caller is
        delta = torch.zeros(motion.lanes, n, dtype=torch.float64, requires_grad=True)
        if motion.adjoint is not None:
            return _backwards(f, shared, motion.adjoint, delta)
        found = f(shared.moved(delta))
        value, rows = found.detach(), found[0].numel()
        if rows <= n:
            return Valued(value, _reversed(found, delta).reshape(*value.shape, n))
        motion.prepare()
        gradient = torch.func.jacfwd(lambda delta: f(shared.moved(delta)))(torch.zeros(n, dtype=torch.float64))
        assert isinstance(gradient, Tensor)
        return Valued(value, gradient)


def _backwards(f: Callable[[Any], Tensor], motion: Trajectory, adjoint: Adjoint, delta: Tensor) -> Valued:
    """The same by the adjoint of the motion."""
    opened, leaves = motion.opened(delta)
    found = f(opened)
    value, parts = found.detach(), []
    for some in found.flatten(1).sum(0).split(ROWS) if found.dim() > 1 else [found.sum()[None]]:
        if not some.requires_grad:  # of nothing that depends on the design
            parts.append(delta.new_zeros(len(delta), len(some), delta.shape[1]))
            continue
        slopes = [
            torch.autograd.grad(x, [delta, *leaves], retain_graph=True, allow_unused=True, materialize_grads=True)
            for x in some.unbind()
        ]
        direct, *bars = zip(*slopes, strict=True)
        parts.append(torch.stack(direct, 1) + adjoint([torch.cat(x, 2) for x in bars]))
    return Valued(value, torch.cat(parts, 1).reshape(*value.shape, delta.shape[1]))


def _reversed(found: Tensor, delta: Tensor) -> Tensor:
    """Gradients of rows [lanes, ...] by delta [lanes, n]: [lanes, rows, n]."""
    if not found.requires_grad:  # of nothing that depends on the design
        return delta.new_zeros(len(found), found[0].numel(), delta.shape[1])
    sums = found.flatten(1).sum(0) if found.dim() > 1 else found.sum()[None]
    return torch.stack([torch.autograd.grad(x, delta, retain_graph=True)[0] for x in sums.unbind()], 1)
