"""Numbers that a user gives: checked by kind and range, and copied, so that a later change of the argument changes nothing.

Checked in tests/math/test_checked_numbers.py.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from torchmbd.errors import InputError, Path
from torchmbd.math.gradients import double_precision, refuse_gradients
from torchmbd.math.units import in_si


def reals(name: str | Path, value: ArrayLike | Tensor) -> Tensor:
    """Read numbers of any shape as float64; InputError names the argument."""
    return _read(name, value, "numbers").double()


def differentiable_reals(name: str | Path, value: Any, allowed: str) -> Tensor:
    """Read numbers of any shape as float64 with their gradients, also those of tensors in a list."""
    try:
        return _joined(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(name, value, allowed) from error


def _joined(value: Any) -> Tensor:
    if isinstance(value, list | tuple):  # torch.as_tensor would take the numbers of its tensors alone
        return torch.stack([_joined(x) for x in value])
    return torch.as_tensor(value, dtype=torch.float64)


def scalar(name: str | Path, value: Any, allowed: str = "a finite number", unit: str = "") -> float:
    """Read one finite number as a float; InputError names the argument, also one with a gradient, which a float would lose."""
    refuse_gradients(name, value, allowed)
    try:
        x = math.nan if isinstance(value, (str, bytes, bool)) else float(value)
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a tensor of several numbers
        x = math.nan
    if not math.isfinite(x):
        raise InputError(name, value, allowed, in_si(value), shown=with_unit(value, unit))
    return x


def with_unit(value: object, unit: str) -> str:
    """The value with the unit " m" of its argument, for a message; a text has no unit, or its own."""
    return repr(value) if isinstance(value, str) else f"{value!r}{unit}"


def is_whole(x: Any) -> bool:
    """True if x is an integer of Python or NumPy, not a bool."""
    return isinstance(x, numbers.Integral) and not isinstance(x, bool)


def is_real(x: Any) -> bool:
    """True if x is a real number of Python or NumPy, not a bool."""
    return isinstance(x, numbers.Real) and not isinstance(x, bool)


def positive(name: str | Path, value: Any, unit: str) -> float:
    """Read one positive finite number."""
    allowed = "a positive and finite number"
    x = scalar(name, value, allowed, f" {unit}")
    if not x > 0.0:
        raise InputError(name, value, allowed, shown=f"{value!r} {unit}".rstrip())
    return x


def nonnegative(name: str | Path, value: Any, unit: str) -> float:
    """Read one finite number that is zero or positive."""
    allowed = "zero, or a positive and finite number"
    x = scalar(name, value, allowed, f" {unit}")
    if x < 0.0:
        raise InputError(name, value, allowed, shown=f"{value!r} {unit}".rstrip())
    return x


def indices(name: str | Path, value: ArrayLike | Tensor) -> Tensor:
    """Read whole numbers of any shape as int64; InputError names the argument and the number."""
    x = _read(name, value, "whole numbers")
    broken = (x != x.round()).flatten() if x.is_floating_point() else torch.zeros(0, dtype=torch.bool)
    if broken.any():
        raise InputError(name, allowed="whole numbers", state=f"holds {float(x.flatten()[broken][0])!r}")
    return x.long()


def list_of(name: str | Path, value: Any, kinds: type | tuple[type, ...], allowed: str) -> list[Any]:
    """Read a sequence of objects of some classes as a list; InputError names the argument and an object of another class."""
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise InputError(name, value, f"a list of {allowed}")
    for x in value:
        if not isinstance(x, kinds):
            raise InputError(name, allowed=f"a list of {allowed}", state=f"has {x!r}")
    return list(value)


def parameter(name: str | Path, value: ArrayLike | Tensor) -> nn.Parameter:
    """The parameter `value`, or a new one of numbers of any shape; InputError for a computed tensor with a gradient."""
    if not isinstance(value, nn.Parameter):
        refuse_gradients(name, value, "numbers, or a torch.nn.Parameter", parameter=True)
        return nn.Parameter(reals(name, value))
    double_precision(name, value)
    return value


def _read(name: str | Path, value: ArrayLike | Tensor, allowed: str) -> Tensor:
    refuse_gradients(name, value, allowed)
    try:
        x = (value.detach() if isinstance(value, Tensor) else torch.from_numpy(np.array(value))).clone()
    except (TypeError, ValueError) as error:
        raise InputError(name, value, allowed) from error
    if x.is_complex():
        raise InputError(name, value, f"{allowed}, real ones")
    return x
