"""Differentiable functions of lanes that groups of lanes compute, which threads share (threads.py).

    y[group], ... = function(x[group], ...)         x, y [lanes, ...]: results of a lane depend on no other lane

A group has a graph of torch of its own. So arrays stay in the cache of a processor, and threads share the backward pass, too.
One group, forward mode and transforms of torch.func need none of this: there the function is called once.
Differentiable once in reverse mode. Results have the same bits with any number of threads.
Checked in tests/math/test_lane_groups.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from torchmbd.math.gradients import refuse_batched_by_grad, wraps
from torchmbd.math.pull_back import pull_back
from torchmbd.math.threads import lane_groups, map_threads
from torchmbd.math.vmap import FirstDerivative, batch_first

Function = Callable[..., tuple[Tensor, ...]]


def by_groups(function: Function, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Return function(*tensors).

    function   of tensors [lanes, ...], to a tuple of such; other tensors that it uses must not be differentiated
    """
    groups = lane_groups(len(tensors[0]))
    alike = all(len(x) == len(tensors[0]) for x in tensors)
    if len(groups) == 1 or not alike or wraps(*tensors) or any(unpack_dual(x).tangent is not None for x in tensors):
        return function(*tensors)
    if not torch.is_grad_enabled() or not any(x.requires_grad for x in tensors):
        return _Groups(function, groups).values(tensors, [False] * len(tensors))
    return _Grouped.apply(_Groups(function, groups), *tensors)  # pyright: ignore[reportReturnType]


class _Groups:
    """The groups, and the leaves and results of the graph of each."""

    def __init__(self, function: Function, groups: list[slice]) -> None:
        self.function, self.groups = function, groups
        self.graphs: list[tuple[list[Tensor], tuple[Tensor, ...]]] = []

    def values(self, tensors: Sequence[Tensor], differentiated: Sequence[bool]) -> tuple[Tensor, ...]:
        """The results of all lanes."""

        def run(group: slice) -> tuple[list[Tensor], tuple[Tensor, ...]]:
            leaves = [x[group].detach().requires_grad_(d) for x, d in zip(tensors, differentiated, strict=True)]
            with torch.set_grad_enabled(any(differentiated)):
                return leaves, self.function(*leaves)

        self.graphs = graphs = map_threads(run, self.groups)
        return tuple(
            self._joined([x.detach() for x in parts], 0) for parts in zip(*(y for _, y in graphs), strict=True)
        )

    def pulled(self, needed: Sequence[bool], cotangents: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
        """Cotangents [rows, lanes, ...] of the tensors that need one, from those of the results (None: zero)."""
        rows = next(len(x) for x in cotangents if x is not None)

        def pull(group: slice, graph: tuple[list[Tensor], tuple[Tensor, ...]]) -> list[Tensor]:
            leaves = [x for x, n in zip(graph[0], needed, strict=True) if n]
            pairs = zip(graph[1], cotangents, strict=True)
            used = [(y, x[:, group]) for y, x in pairs if x is not None and y.requires_grad]
            if not used:
                return [x.new_zeros(rows, *x.shape) for x in leaves]
            outputs = [y for y, _ in used]
            each = [pull_back(outputs, leaves, [x[k : k + 1] for _, x in used]) for k in range(rows)]
            return [torch.cat(parts) for parts in zip(*each, strict=True)]

        return tuple(self._joined(parts, 1) for parts in zip(*map_threads(pull, self.groups, self.graphs), strict=True))

    def _joined(self, parts: Sequence[Tensor], axis: int) -> Tensor:
        """Tensors of groups as one along the axis of lanes."""
        shape = list(parts[0].shape)
        shape[axis] = self.groups[-1].stop
        result = parts[0].new_empty(shape)

        def write(group: slice, part: Tensor) -> None:
            result.narrow(axis, group.start, group.stop - group.start).copy_(part)

        map_threads(write, self.groups, parts)
        return result


class _Grouped(torch.autograd.Function):
    """(groups, tensors) -> results; see the module header."""

    @staticmethod
    def forward(ctx: Any, groups: _Groups, *tensors: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.groups = groups
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        return groups.values(tensors, ctx.needs_input_grad[1:])

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        needed = ctx.needs_input_grad[1:]
        refuse_batched_by_grad(cotangents)
        if all(x is None for x in cotangents):
            return (None,) * (1 + len(needed))
        pulled = iter(_Pulled.apply(ctx.groups, needed, *ctx.saved_tensors, *cotangents))  # pyright: ignore[reportArgumentType]
        return None, *(next(pulled) if n else None for n in needed)


class _Pulled(FirstDerivative):
    """(groups, which tensors need cotangents, tensors, cotangents of the results) -> these cotangents."""

    of = "functions of groups of lanes"

    @staticmethod
    def forward(groups: _Groups, needed: Sequence[bool], *tensors: Tensor | None) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        cotangents = tensors[len(needed) :]
        return tuple(x[0] for x in groups.pulled(needed, [x if x is None else x[None] for x in cotangents]))

    @staticmethod
    def vmap(info: Any, in_dims: tuple, groups: _Groups, needed: Sequence[bool], *tensors: Tensor | None) -> Any:
        n = len(needed)
        each = zip(tensors[n:], in_dims[2 + n :], strict=True)
        result = groups.pulled(needed, [x if x is None else batch_first(x, d, info.batch_size) for x, d in each])
        return result, (0,) * len(result)
