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

from torchmbd.errors import InputError
from torchmbd.integrators import Trajectory
from torchmbd.integrators.adjoint import Adjoint
from torchmbd.numerics.called import exclusive

ROWS = 16  # that go back together: their derivatives by a whole motion are all in memory


class Valued(NamedTuple):
    """A value with its design gradient; None for a motion without sensitivities."""

    value: Tensor
    gradient: Tensor | None


@exclusive
def differentiate(f: Callable[[Any], Tensor], motion: Trajectory) -> Valued:
    """f(motion) [lanes, ...] with its gradient [lanes, ..., n_b].

    In reverse mode where f has no more numbers than there are design variables, else in forward mode. Lanes know nothing of
    each other: the gradient of a sum over lanes by the neighbor of each lane is that of each.
    """
    if not hasattr(motion, "known"):
        raise InputError(f"motion is {motion!r}; allowed: a motion, as mbd.simulate(...) makes it")
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
    parts = [_some_backwards(some, [delta, *leaves], adjoint) for some in _sums(found).split(ROWS)]
    return Valued(found.detach(), torch.cat(parts, 1).reshape(*found.shape, delta.shape[1]))


def _some_backwards(sums: Tensor, by: list[Tensor], adjoint: Adjoint) -> Tensor:
    """Gradients [lanes, rows, n] of sums over lanes [rows]; by: delta [lanes, n] and what the adjoint takes."""
    delta, lanes = by[0], len(by[0])
    if not sums.requires_grad:  # of nothing that depends on the design
        return delta.new_zeros(lanes, len(sums), delta.shape[1])
    slopes = [torch.autograd.grad(x, by, retain_graph=True, allow_unused=True) for x in sums.unbind()]
    direct, *bars = (
        None if all(x is None for x in some) else [torch.zeros_like(like) if x is None else x for x in some]
        for some, like in zip(zip(*slopes, strict=True), by, strict=True)
    )
    found = delta.new_zeros(lanes, len(sums), delta.shape[1]) if direct is None else torch.stack(direct, 1)
    if any(bars) and adjoint.dynamics.tangents:  # else the motion depends on no variable
        found = found + adjoint([None if x is None else torch.cat(x, 2) for x in bars])
    return found


def _sums(found: Tensor) -> Tensor:
    """Rows of numbers [lanes, ...], each summed over the lanes."""
    return found.flatten(1).sum(0) if found.dim() > 1 else found.sum()[None]


def _reversed(found: Tensor, delta: Tensor) -> Tensor:
    """Gradients of rows [lanes, ...] by delta [lanes, n]: [lanes, rows, n]."""
    if not found.requires_grad:  # of nothing that depends on the design
        return delta.new_zeros(len(found), found[0].numel(), delta.shape[1])
    return torch.stack([torch.autograd.grad(x, delta, retain_graph=True)[0] for x in _sums(found).unbind()], 1)
