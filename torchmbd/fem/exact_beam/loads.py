"""Loads and supports of an exact beam as numbers of its nodes.

Checked in tests/fem/exact_beam/test_loads.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements import FREEDOMS, BeamLine
from torchmbd.math.checked_numbers import differentiable_reals, is_whole
from torchmbd.math.gradients import all_true, refuse_gradients

Loads = Mapping[Any, Sequence[float] | Tensor]
Supports = Mapping[Any, str | Sequence[float | None]]


def nodes_of(line: BeamLine, place: Any) -> list[int]:
    """Return the nodes that a name, a number, or a tuple of these stands for."""
    if isinstance(place, str):
        return list(line.node_set(place))
    if isinstance(place, tuple | list):
        return [k for node in place for k in nodes_of(line, node)]
    if not is_whole(place) or not 0 <= place < len(line.nodes):
        raise InputError("node", place, f"a name, 0 to {len(line.nodes) - 1}, or a tuple of these")
    return [int(place)]


def read_wrench(name: str, wrench: Any) -> Float[Tensor, "*lanes 6"]:
    """Read a force, or force and moment, with its gradient; InputError names the argument."""
    x = differentiable_reals(name, wrench, "3 or 6 finite numbers")
    if x.dim() == 0 or x.shape[-1] not in (3, 6) or not all_true(torch.isfinite(x)):
        raise InputError(name, wrench, "3 or 6 finite numbers")
    return x if x.shape[-1] == 6 else torch.cat([x, torch.zeros_like(x)], -1)


def read_vector(name: str, vector: Any) -> Float[Tensor, " 3"]:
    """Read three numbers with their gradient."""
    x = differentiable_reals(name, vector, "three finite numbers")
    if x.shape != (3,) or not all_true(torch.isfinite(x)):
        raise InputError(name, vector, "three finite numbers")
    return x


def nodal_loads(name: str, line: BeamLine, loads: Loads | None) -> Float[Tensor, "n 6"]:
    """Return the loads of all nodes; the nodes of a set share its load evenly."""
    total = torch.zeros(len(line.nodes), 6, dtype=torch.float64)
    if loads is None:
        return total
    if not isinstance(loads, Mapping):
        raise InputError(name, loads, "a mapping node -> force, or force and moment")
    for where, wrench in loads.items():
        load = read_wrench(f"{name}[{where!r}]", wrench)
        if load.shape != (6,):
            raise InputError(
                (name, str(where)),
                allowed="3 or 6 numbers",
                state=f"has shape {tuple(load.shape)}",
                noun=f"{name}[{where!r}]",
            )
        nodes = nodes_of(line, where)
        total = total.index_add(0, torch.tensor(nodes), (load / len(nodes)).expand(len(nodes), 6))
    return total


def line_loads(name: str, line: BeamLine, wrench: Any) -> Float[Tensor, "m 6"]:
    """Return the loads per length of all elements."""
    m = len(line.elements)
    if wrench is None:
        return torch.zeros(m, 6, dtype=torch.float64)
    load = read_wrench(name, wrench)
    if load.shape not in ((6,), (m, 6)):
        raise InputError(
            name,
            load,
            f"3 or 6 numbers, or 3 or 6 numbers for each of {m} elements",
            state=f"has shape {tuple(load.shape)}",
        )
    return load.expand(m, 6)


def element_change(name: str, line: BeamLine, change: Any) -> Float[Tensor, " m"]:
    """Return a change of temperature or moisture of all elements: one for all, or one for each."""
    m = len(line.elements)
    allowed = f"a finite number, or one for each of {m} elements"
    x = differentiable_reals(name, change, allowed)
    if x.shape not in ((), (m,)):
        raise InputError(name, x, allowed, state=f"has shape {tuple(x.shape)}")
    if not all_true(torch.isfinite(x)):
        raise InputError(name, change, allowed)
    return x.expand(m)


def supported_freedoms(name: str, line: BeamLine, supports: Supports | None) -> tuple[list[int], Float[Tensor, "n 6"]]:
    """Return the held degrees of freedom 6 * node + i, and the imposed motions [n, 6]; default: all of "start"."""
    supports = {"start": "all"} if supports is None else supports
    if not isinstance(supports, Mapping) or not supports:
        raise InputError((name, "supports"), supports, "a mapping node -> degrees of freedom, with at least one node")
    places: dict[int, float] = {}
    for where, support in supports.items():
        values = _values(f"support {where!r} of {name!r}", support)
        for node in nodes_of(line, where):
            for i, x in enumerate(values):
                if x is not None and places.setdefault(6 * node + i, x) != x:
                    raise InputError(
                        (name, "supports"),
                        allowed="must give one value",
                        state=f"give {FREEDOMS[i]} of node {node} two values",
                    )
    imposed = torch.zeros(6 * len(line.nodes), dtype=torch.float64)
    imposed[list(places)] = torch.tensor(list(places.values()), dtype=torch.float64)
    for node in {f // 6 for f in places}:
        turns = [places[f] for f in range(6 * node + 3, 6 * node + 6) if f in places]
        if len(turns) == 1 or (len(turns) == 2 and any(turns)):
            raise InputError(
                (name, "supports", node),
                allowed="must hold none of them, all three, or two at 0 (a hinge), because rotations are finite",
                state=f"hold {len(turns)} rotations of node {node}",
                noun=f"supports of {name!r}",
            )
    return sorted(places), imposed.reshape(-1, 6)


def _values(name: str, support: Any) -> list[float | None]:
    if isinstance(support, str):
        names = list(FREEDOMS) if support == "all" else support.replace(",", " ").split()
        if names and all(x in FREEDOMS for x in names):
            return [0.0 if x in names else None for x in FREEDOMS]
    elif isinstance(support, Sequence) and len(support) == 6:
        refuse_gradients(name, support, "six numbers, None where it is free")
        numbers: list[float | None]
        try:
            numbers = [None if x is None else float(x) for x in support]
        except (TypeError, ValueError):
            numbers = [float("nan")]
        if all(x is None or abs(x) < float("inf") for x in numbers):
            return numbers
    raise InputError(
        name, support, f"some of {' '.join(FREEDOMS)}, or 'all', or six numbers with None for a free degree of freedom"
    )
