"""Data of a batch as native code takes them: in memory order (symbolic.py), blocks of lanes.

Checked in tests/extensions/native/test_steps.py.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchmbd.extensions.native.symbolic import SHAPES, Kind, constants_name, form, groups, memory_order, numbers_of
from torchmbd.math.pair import Pair, cat, linear, value
from torchmbd.multibody.system.dynamics import Dynamics


def kind_of(dynamics: Dynamics) -> Kind:
    """The kind of mechanism of a system."""
    return Kind.of(dynamics.topology, dynamics.data, dynamics.saddle.blocks)


def flat_values(dynamics: Dynamics) -> Tensor:
    """Values [n, 1, lanes] of all data.

    Behind them zeros for what laws with design variables prescribe (`varied_numbers`): it changes from step to step.
    """
    return torch.cat([value(x).expand(-1, 1, dynamics.lanes) for x in _flat_parts(dynamics)])


def flat_tangents(dynamics: Dynamics) -> Tensor:
    """Their tangents [n, n_b, lanes]."""
    lanes, n_b = dynamics.lanes, dynamics.tangents
    if not n_b:
        return torch.zeros(0, 0, lanes, dtype=torch.float64)

    def tangents(x: Any) -> Tensor:
        tangent = x.tangent if isinstance(x, Pair) else x.new_zeros(len(x), n_b, 1)
        return tangent.expand(-1, -1, lanes)

    return torch.cat([tangents(x) for x in _flat_parts(dynamics)])


def _flat_parts(dynamics: Dynamics) -> list[Any]:
    parts = [linear(lambda y: y.reshape(-1, *y.shape[-2:]), x) for x in _in_memory(dynamics).values()]
    T = dynamics.topology
    varied = sum(T.primitives[i].driven * len(T.primitives[i].data) for i in T.varying_primitives)
    return [*parts, value(parts[0]).new_zeros(varied, 1, 1)]


def _in_memory(dynamics: Dynamics) -> dict[str, Any]:
    """Data in the order in which they stand in memory [..., pair, lanes]."""
    parts: dict[str, Any] = {}
    for name in kind_of(dynamics).data:
        order = memory_order(SHAPES[name])
        parts[name] = linear(lambda y, order=order: y.permute(*order, -2, -1), dynamics.data[name])
    for i, p in enumerate(dynamics.topology.primitives):
        if p.constants:
            parts[constants_name(i)] = p.numbers.movedim(1, 0)
    for i, (key, some) in enumerate(groups(dynamics.topology).items()):
        if numbers_of(key.law):
            rows = [form(law)[1] for _, _, law in some]  # [actions][numbers]
            parts[f"~law {i}"] = cat([_number(x, dynamics) for row in rows for x in row])
    return parts


def _number(x: Any, dynamics: Dynamics) -> Any:
    """A number of a law [1, pair, lanes]."""
    if isinstance(x, tuple):
        key, row = x
        return dynamics.data[key][row : row + 1]
    return torch.full((1, 1, 1), float(x), dtype=torch.float64)


def unflattened(dynamics: Dynamics, by: Tensor) -> dict[str, Tensor]:
    """Cotangents of the data [component..., rows, lanes] out of those of what stands in memory [n, rows, lanes]."""
    T, start, result = dynamics.topology, 0, {}
    for name in kind_of(dynamics).data:
        order, shape = memory_order(SHAPES[name]), value(dynamics.data[name]).shape[:-2]
        part = by[start : start + shape.numel()].reshape(*(shape[d] for d in order), *by.shape[1:])
        result[name] = part.permute(*(order.index(d) for d in range(len(order))), -2, -1)
        start += shape.numel()
    start += sum(p.numbers.shape[:2].numel() for p in T.primitives if p.constants)  # no design varies them
    for name, x in dynamics.data.items():
        if name not in result:
            result[name] = by.new_zeros(*x.shape[:-2], *by.shape[1:])
    for key, some in groups(T).items():
        if numbers_of(key.law):
            for x in (y for _, _, law in some for y in form(law)[1]):
                if isinstance(x, tuple):
                    result[x[0]][x[1]] += by[start]
                start += 1
    return result
