"""Design gradients of functions of a motion, lane by lane: the chain rule of eq. (27) by torch.

Lanes do not see each other: the gradient of a sum over lanes by the designs of each lane is that of each.
Checked in tests/contracts/test_responses.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.math.module_call import exclusive

ROWS = 16  # whose cotangents of a whole motion are in memory at a time


class Valued(NamedTuple):
    """A value with its design gradient; None for a motion that has none."""

    value: Tensor
    gradient: Tensor | None


@exclusive
def differentiate(f: Callable[[Any], Tensor | Sequence[Tensor]], motion: Trajectory) -> Valued:
    """f(motion) [lanes, ...] with its gradient [lanes, ..., n_b] by `motion.variables`.

    Where the value is nan, as in lanes that failed, the gradient is.

    f may return several tensors [lanes, rows], which become one: each is pulled back by itself, so that many rows of one cost
    nothing of what another is computed from.
    """
    if not isinstance(motion, Trajectory):
        raise InputError(f"motion is {motion!r}; allowed: a motion, as mbd.simulate(...) makes it")
    shared = replace(motion, known={})  # what measures share lives as long as this
    inputs = list(motion.variables.values())
    if not any(x.requires_grad for x in inputs):
        with torch.no_grad():
            return Valued(_joined(f(shared)), None)
    with torch.inference_mode(False), torch.enable_grad():  # wherever the caller is
        given = f(shared)
        each = [given] if isinstance(given, Tensor) else given
        rows = [x.flatten(1).sum(0) if x.dim() > 1 else x.sum()[None] for x in each]  # of each row the sum over lanes
        parts = [_gradients(some, inputs) for own in rows for some in own.split(ROWS)]
    found = _joined(given).detach()
    gradient = torch.cat(parts, 1).reshape(*found.shape, -1)
    return Valued(found, torch.where(found.isnan()[..., None], torch.nan, gradient))  # of lanes that failed


def _joined(found: Tensor | Sequence[Tensor]) -> Tensor:
    return found if isinstance(found, Tensor) else torch.cat(list(found), 1)


def _gradients(rows: Tensor, inputs: Sequence[Tensor]) -> Tensor:
    """Gradients [lanes, rows, n_b] of numbers [rows] by inputs [lanes, ...]."""
    if not rows.requires_grad:  # of nothing that depends on the design
        return torch.zeros(len(inputs[0]), len(rows), sum(x[0].numel() for x in inputs), dtype=torch.float64)
    options: dict[str, Any] = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}

    def pulled(weights: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad(rows, inputs, weights, **options)

    unit = torch.eye(len(rows), dtype=rows.dtype)  # all rows in one pass, as `Motion` does them
    found = torch.vmap(pulled)(unit) if len(rows) > 1 else pulled(unit[0])
    return torch.cat([x.reshape(len(rows), len(y), -1) for x, y in zip(found, inputs, strict=True)], -1).transpose(0, 1)
