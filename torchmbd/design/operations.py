"""Operations that combine responses and numbers: how they are written, and whether zero keeps its meaning.

Checked in tests/contracts/test_responses.py, tests/design/test_invariant_verdicts.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.checked_numbers import scalar

SIGNS = {torch.add: "+", torch.sub: "-", torch.mul: "*", torch.div: "/", torch.pow: "**"}


def formula(operation: Callable[..., Tensor], parts: Sequence[Any]) -> str:
    """An operation on responses and numbers as Python writes it."""
    if operation in SIGNS:
        first, second = map(repr, parts)
        return f"({first} {SIGNS[operation]} {second})"
    return f"{getattr(operation, '__name__', 'operation')}({', '.join(map(repr, parts))})"


def keeps_zero(operation: Callable[..., Tensor], parts: Sequence[Any]) -> bool:
    """True if an operation on responses and numbers has a natural zero: all responses have one, and none is shifted."""
    shifted = operation in (torch.add, torch.sub) and any(is_number(part) and part for part in parts)
    return not shifted and all(is_number(part) or part.natural_zero for part in parts)


def settle(response: Any, field: str, value: Any) -> None:
    """Set a field of a frozen response while it is made."""
    object.__setattr__(response, field, value)


def operand(part: Any, kind: type, noun: str, allowed: str) -> Any:
    """Return a response of this kind or a number of Python as it is, another number, such as mbd.deg(90), as a float."""
    if isinstance(part, kind):
        return part
    number = scalar("operand", part, allowed)
    return part if isinstance(part, (int, float)) else number


def is_number(x: Any) -> bool:
    """Return whether an operand is a finite number and not a response."""
    try:
        number = x.detach() if isinstance(x, Tensor) else x  # a variable is refused by name later
        return not isinstance(x, (str, bool)) and abs(float(number)) < float("inf")
    except (TypeError, ValueError):
        return False
