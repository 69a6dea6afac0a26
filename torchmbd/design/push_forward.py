"""Jacobians of many numbers of a motion by few variables: the tangents of the motion, pushed through a function of it.

    d f / d b = f'(outputs, b) . (d outputs / d b, d b / d b)        one pass for each variable, all at once by torch.func.vmap

`differentiate` pulls back rows, sixteen at a time; thousands of rows, such as samples of a measurement, are pushed forward
here in the time of a few evaluations of f. The motion must have its tangents: simulate(..., gradients="forward").
Checked in tests/design/test_push_forward.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmbd.design.differentiate import ValueAndGradient
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.integrate.forward_integration import ForwardIntegration
from torchmbd.integrate.simulate import trajectory_of
from torchmbd.math.module_call import exclusive


@exclusive
def push_forward(f: Callable[[Any], Tensor], motion: Trajectory) -> ValueAndGradient:
    """f(motion) [lanes, ...] with its gradient [lanes, ..., n_b] by `motion.variables`, which is nan where the value is.

    Raises InputError for a motion of reverse mode, or one without gradients.
    """
    made = motion.integration
    if not isinstance(made, ForwardIntegration) or not motion.variables:
        raise InputError("the motion has no tangents; allowed: simulate(..., gradients='forward')")
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
            return torch.func.jvp(of_outputs, (outputs, moving), (directions, of_designs))

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
