"""Gradients of functions of a motion by the design variables of each lane: the chain rule of eq. (27) by torch.

`differentiate` pulls back rows, sixteen at a time. Lanes are independent: the gradient of a sum over lanes by the design of a
lane is the gradient of this lane's term.

`push_forward` is for thousands of rows, such as samples of a measurement, by few variables: the tangents of the motion
(simulate(..., gradients="forward")) pushed through f, in the time of a few evaluations of f.

    d f / d b = f'(outputs, b) . (d outputs / d b, d b / d b)        one pass for each variable, all at once by torch.func.vmap

Checked in tests/contracts/test_responses.py, tests/design/test_differentiate.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.integrate.forward_integration import ForwardIntegration
from torchmbd.integrate.integrated_trajectory import trajectory_of
from torchmbd.math.forward_mode import jvp
from torchmbd.math.module_call import exclusive
from torchmbd.math.pull_back import pull_back

ROWS = 16  # rows whose cotangents of a whole motion are in memory at the same time


class ValueAndGradient(NamedTuple):
    """A value [lanes, ...] and its gradient [lanes, ..., n_b]; None for a motion without gradients."""

    value: Tensor
    gradient: Tensor | None


@exclusive
def differentiate(f: Callable[[Any], Tensor | Sequence[Tensor]], motion: Trajectory) -> ValueAndGradient:
    """f(motion) [lanes, ...] with its gradient [lanes, ..., n_b] by `motion.variables`.

    The gradient is nan where the value is, as in lanes that failed.

    f may return several tensors [lanes, rows], whose rows are concatenated. Each tensor is pulled back by itself, so that the
    many rows of one tensor are not pulled back through the operations of another.
    """
    if not isinstance(motion, Trajectory):
        raise InputError("motion", motion, "a motion, the result of mbd.simulate(...)")
    shared = replace(motion, known={})  # curves that measures share are kept until this function returns
    inputs = list(motion.variables.values())
    if not any(x.requires_grad for x in inputs):
        with torch.no_grad():
            return ValueAndGradient(_joined(f(shared)), None)
    with torch.inference_mode(False), torch.enable_grad():  # in any mode of the caller
        values = f(shared)
        tensors = [values] if isinstance(values, Tensor) else values
        sums = [x.flatten(1).sum(0) if x.dim() > 1 else x.sum()[None] for x in tensors]  # over lanes [rows]
        parts = [_gradients(rows, inputs) for sum_of_tensor in sums for rows in sum_of_tensor.split(ROWS)]
    value = _joined(values).detach()
    gradient = torch.cat(parts, 1).reshape(*value.shape, -1)
    return ValueAndGradient(value, torch.where(value.isnan()[..., None], torch.nan, gradient))


def _joined(values: Tensor | Sequence[Tensor]) -> Tensor:
    return values if isinstance(values, Tensor) else torch.cat(list(values), 1)


def _gradients(rows: Tensor, inputs: Sequence[Tensor]) -> Tensor:
    """Gradients [lanes, rows, n_b] of numbers [rows] by inputs [lanes, ...]."""
    if not rows.requires_grad:  # no row depends on the design
        return torch.zeros(len(inputs[0]), len(rows), sum(x[0].numel() for x in inputs), dtype=torch.float64)
    gradients = pull_back([rows], inputs, [torch.eye(len(rows), dtype=rows.dtype)])  # all rows in one backward pass
    parts = [x.reshape(len(rows), len(y), -1) for x, y in zip(gradients, inputs, strict=True)]
    return torch.cat(parts, -1).transpose(0, 1)


@exclusive
def push_forward(f: Callable[[Any], Tensor], motion: Trajectory) -> ValueAndGradient:
    """f(motion) [lanes, ...] with its gradient [lanes, ..., n_b] by `motion.variables`, which is nan where the value is.

    Raises InputError for a motion of reverse mode, or one without gradients.
    """
    made = motion.integration
    if not isinstance(made, ForwardIntegration) or not motion.variables:
        raise InputError(
            "motion", allowed="must have tangents", state="has no tangents", hint="simulate(..., gradients='forward')"
        )
    names, designs = list(motion.variables), {name: x.detach() for name, x in motion.designs.items()}
    moving = {name: designs[name] for name in names}
    directions = _units(moving)
    with torch.no_grad():
        # As of Motion: lanes last, tangents before them.
        inner = [directions[name].movedim((0, 1), (-2, -1)) if name in names else None for name in made.names]
        tangents = tuple(x.movedim(-2, 0).unsqueeze(-2) for x in made.tangents(inner))
        outputs = tuple(made.outputs.values())
        tangents = tuple(x.expand(-1, *y.shape) for x, y in zip(tangents, outputs, strict=True))

        def of_outputs(outputs: tuple[Tensor, ...], moving: dict[str, Tensor]) -> Tensor:
            same = trajectory_of(made.system, made, outputs, made.dynamics.data, designs | moving, names)
            same.actions = made.actions
            return f(same)

        def push(directions: tuple[Tensor, ...], of_designs: dict[str, Tensor]) -> Any:
            return jvp(of_outputs, (outputs, moving), (directions, of_designs))

        values, slopes = torch.func.vmap(push)(tangents, directions)
    value, gradient = values[0], slopes.movedim(0, -1)
    return ValueAndGradient(value, torch.where(value.isnan()[..., None], torch.nan, gradient))


def _units(moving: dict[str, Tensor]) -> dict[str, Tensor]:
    """Unit directions of all entries, the same in all lanes: by name [n_b, lanes, ...]."""
    sizes = {name: x[0].numel() for name, x in moving.items()}
    unit, result, first = torch.eye(sum(sizes.values()), dtype=torch.float64), {}, 0
    for name, x in moving.items():
        rows = unit[:, None, first : first + sizes[name]].expand(-1, len(x), -1)
        result[name] = rows.reshape(-1, *x.shape)
        first += sizes[name]
    return result
