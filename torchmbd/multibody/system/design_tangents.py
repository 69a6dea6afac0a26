"""Tangents of the structure stage by design variables: one linearization, evaluated along all directions at once.

Checked in tests/multibody/system/test_system.py, tests/sensitivity/test_gradients.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.pair import Pair


def unit_directions(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Unit directions [n_b, lanes, ...], one for each entry of the parameters [lanes, ...], the same in all lanes."""
    sizes = {name: x[0].numel() for name, x in parameters.items()}
    total, start = sum(sizes.values()), 0
    directions = {}
    for name, x in parameters.items():
        unit = torch.zeros(total, sizes[name], dtype=x.dtype, device=x.device)
        unit[start : start + sizes[name]] = torch.eye(sizes[name], dtype=x.dtype, device=x.device)
        directions[name] = unit.reshape(total, 1, *x.shape[1:]).expand(total, *x.shape)
        start += sizes[name]
    return directions


def tangents_of(stage: Any, parameters: dict[str, Tensor]) -> dict[str, Any]:
    """Values and tangents of the structure stage by the `parameters` [lanes, ...], as pairs.

    A quantity whose tangents are zero in all lanes and directions becomes a plain tensor, which costs less in the steps.
    """

    def push(direction: dict[str, Tensor]) -> tuple:
        return torch.func.jvp(stage, (parameters,), (direction,))

    values, tangents = torch.func.vmap(push, out_dims=(None, 0))(unit_directions(parameters))  # pyright: ignore[reportArgumentType]
    result: dict[str, Any] = {}
    for name, x in values.items():
        dx = tangents[name].movedim(0, -1).squeeze(-3).movedim(-1, -2)
        result[name] = Pair.of(x, dx) if bool(dx.any()) else x
    return result
