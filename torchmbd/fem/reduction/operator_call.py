"""Rules of first derivatives of functions of matrices, written with loops and NumPy, as operators of torch.

Under transforms of torch.func a rule runs once: `vmap` over tangents adds columns to its one solve, `vmap` over designs adds
lanes. Second derivatives raise NotImplementedError.
The batched gradients of torch.autograd (is_grads_batched, gradcheck) ignore the vmap rules of Functions and cannot batch loops
and NumPy. An operator of torch is called for each slice of the batch instead. It is registered by its schema: the decorator
torch.library.custom_op imports the compiler of torch at its first call, which takes seconds.
Checked in tests/sensitivity/test_spectral.py.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.vmap import FirstDerivative, batch_first

#: From tensors of the design, then of T directions [lane, T, ...] or None, to two new tensors [lane, T, ...].
Rule = Callable[..., tuple[Tensor, Tensor]]
_rules: dict[int, Rule] = {}
_numbers = count()
_NAME = "torchmbd::apply_rule"
# Not one argument Tensor?[]: the batched gradients do not look into lists.
torch.library.define(_NAME, "(int number, Tensor a, Tensor? b, Tensor? c, Tensor? d) -> (Tensor, Tensor)")


@torch.library.impl(_NAME, "cpu")
def _apply_rule(number: int, *tensors: Tensor | None) -> tuple[Tensor, Tensor]:
    return _rules[number](*tensors)


class _RuleDerivative(FirstDerivative):
    """rule(*tensors), of which the first `state` belong to the design."""

    @staticmethod
    def forward(rule: Rule, state: int, *tensors: Tensor | None) -> tuple[Tensor, Tensor]:
        number, size = next(_numbers), len(tensors)
        _rules[number] = lambda *padded: rule(*padded[:size])
        try:
            return torch.ops.torchmbd.apply_rule(number, *tensors, *[None] * (4 - size))
        finally:
            del _rules[number]

    @classmethod
    def vmap(cls, info: Any, in_dims: tuple, rule: Rule, state: int, *tensors: Tensor | None) -> tuple:
        dims, size = in_dims[2:], info.batch_size
        wide = [None if x is None else batch_first(x, dim, size) for x, dim in zip(tensors, dims, strict=True)]
        if all(dim is None for dim in dims[:state]):
            # [B, lane, T, ...] -> [lane, B T, ...]: one solve with more columns
            merged = [None if w is None else w.movedim(0, 1).flatten(1, 2) for w in wide[state:]]
            outputs: Any = cls.apply(rule, state, *tensors[:state], *merged)
            return tuple(o.unflatten(1, (size, -1)) for o in outputs), (1, 1)
        lanes = next(w for w in wide if w is not None).shape[1]
        outputs = cls.apply(rule, state, *(None if w is None else w.flatten(0, 1) for w in wide))
        return tuple(o.unflatten(0, (size, lanes)) for o in outputs), (0, 0)


class ModeDerivative(_RuleDerivative):
    """A rule of the derivatives of modes."""

    of = "modes"


class StaticDerivative(_RuleDerivative):
    """A rule of the derivatives of static displacements."""

    of = "static displacements"
