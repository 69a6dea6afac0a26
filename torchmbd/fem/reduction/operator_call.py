"""Call a Python function as one operator of torch.

The batched gradients of torch.autograd (is_grads_batched, gradcheck) ignore the vmap rules of Functions and cannot batch loops
and NumPy. An operator of torch is called for each slice of the batch instead. It is registered by its schema: the decorator
torch.library.custom_op imports the compiler of torch at its first call, which takes seconds.
Checked in tests/sensitivity/test_spectral.py.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, Tensor]]
_functions: dict[int, Function] = {}
_numbers = count()


def call_as_operator(
    function: Function, a: Tensor, b: Tensor | None = None, c: Tensor | None = None, d: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return function(a, b, c, d), two new tensors without derivatives."""
    number = next(_numbers)
    _functions[number] = function
    try:
        return torch.ops.torchmbd.call_as_operator(number, a, b, c, d)
    finally:
        del _functions[number]


_NAME = "torchmbd::call_as_operator"
torch.library.define(_NAME, "(int number, Tensor a, Tensor? b, Tensor? c, Tensor? d) -> (Tensor, Tensor)")


@torch.library.impl(_NAME, "cpu")
def _call(number: int, a: Tensor, b: Tensor | None, c: Tensor | None, d: Tensor | None) -> tuple[Tensor, Tensor]:
    return _functions[number](a, b, c, d)
