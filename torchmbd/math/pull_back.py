"""Gradients of several outputs, for rows of weights at once.

    by_k = sum_i weights_ki . d outputs_i / d inputs

torch.autograd.grad takes weights too, but imports its symbolic shapes and SymPy to compare their sizes, which takes 0.7 s of a
process; a function of which the weights are the derivatives needs no comparison.
Checked in tests/math/test_pull_back.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


class _Weighted(torch.autograd.Function):
    """A number whose derivatives with respect to the outputs are the `weights` that the list holds when it is pulled back."""

    @staticmethod
    def forward(ctx: Any, weights: list[Tensor], *outputs: Tensor) -> Tensor:
        ctx.weights = weights
        return outputs[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, *ctx.weights


def pull_back(outputs: Sequence[Tensor], inputs: Sequence[Tensor], weights: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Rows of weights [rows, *shape of an output] pulled back to the inputs: [rows, *shape of an input] each, zeros where no
    output depends on one. The graph is kept."""
    held: list[Tensor] = []
    with torch.enable_grad():  # a backward pass, in which this may run, has switched it off
        weighted = _Weighted.apply(held, *outputs)

    def pulled(*row: Tensor) -> tuple[Tensor, ...]:
        held[:] = row
        options: dict[str, Any] = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
        return torch.autograd.grad(weighted, list(inputs), **options)

    try:
        if len(weights[0]) == 1:  # torch.vmap takes as long as another row
            return tuple(x[None] for x in pulled(*(x[0] for x in weights)))
        return torch.vmap(pulled)(*weights)
    finally:
        held.clear()
