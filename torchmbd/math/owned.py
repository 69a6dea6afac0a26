"""Numbers given by a user, read as one's own: a later change of the argument changes nothing here.

Checked in tests/math/test_owned.py.
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
from torch.func import debug_unwrap

from torchmbd.errors import InputError
from torchmbd.math.gradients import differentiated, refuse_gradients

_COMPUTED = "p = x.detach() and then x.backward(p.grad) with the gradient of the parameter p that is made of it"


def reals(name: str, given: ArrayLike | Tensor) -> Tensor:
    """Read numbers of any shape as float64; InputError names the argument."""
    return _read(name, given, "numbers").double()


def scalar(name: str, given: Any, allowed: str = "a finite number", unit: str = "") -> float:
    """Read one finite number; InputError names the argument. A gradient would be lost here, so none is taken."""
    refuse_gradients(name, given, allowed)
    try:
        x = math.nan if isinstance(given, (str, bytes, bool)) else float(given)
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a tensor of several numbers
        x = math.nan
    if not math.isfinite(x):
        raise InputError(f"{name} is {given!r}{unit}; allowed: {allowed}")
    return x


def whole(given: Any) -> bool:
    """Whether it is a whole number, of Python or NumPy; True and False are none."""
    return isinstance(given, numbers.Integral) and not isinstance(given, bool)


def transformed(x: Tensor) -> bool:
    """Whether a transform of torch.func (vmap, grad, jvp) looks at x."""
    return debug_unwrap(x, recurse=False) is not x


def watched(x: Tensor) -> bool:
    """Whether torch differentiates by x here: autograd in grad mode, dual numbers, or a transform of torch.func."""
    return transformed(x) or (differentiated(x) and (torch.is_grad_enabled() or not x.requires_grad))


def plain(x: Tensor) -> Tensor:
    """The numbers of x without transforms of torch.func; a batch of these has an axis more."""
    return debug_unwrap(x).detach()


def all_true(x: Tensor) -> bool:
    """Whether all are true, also of a batch of torch.func.vmap."""
    return bool(plain(x).all())


def real(given: Any) -> bool:
    """Whether it is one real number, of Python or NumPy; True and False are none."""
    return isinstance(given, numbers.Real) and not isinstance(given, bool)


def refuse_derivatives(name: str, x: Tensor, instead: str) -> None:
    """InputError where x is being differentiated (autograd, dual numbers, torch.func) and that would be lost."""
    if watched(x):
        raise InputError(
            f"{name} is being differentiated, which would be lost here; allowed: x.detach(), and {instead}"
        )


def positive(name: str, given: Any, unit: str) -> float:
    """Read one positive finite number."""
    allowed = "a positive and finite number"
    x = scalar(name, given, allowed, f" {unit}")
    if not x > 0.0:
        raise InputError(f"{name} is {given!r} {unit}; allowed: {allowed}")
    return x


def nonnegative(name: str, given: Any, unit: str) -> float:
    """Read one finite number that is zero or positive."""
    allowed = "zero, or a positive and finite number"
    x = scalar(name, given, allowed, f" {unit}")
    if x < 0.0:
        raise InputError(f"{name} is {given!r} {unit}; allowed: {allowed}")
    return x


def indices(name: str, given: ArrayLike | Tensor) -> Tensor:
    """Read whole numbers of any shape as int64; InputError names the argument and the number."""
    x = _read(name, given, "whole numbers")
    broken = (x != x.round()).flatten() if x.is_floating_point() else torch.zeros(0, dtype=torch.bool)
    if broken.any():
        raise InputError(f"{name} holds {float(x.flatten()[broken][0])!r}; allowed: whole numbers")
    return x.long()


def several(name: str, given: Any, kinds: type | tuple[type, ...], allowed: str) -> list[Any]:
    """Read a list of things of some kinds; InputError names the argument and what is none."""
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise InputError(f"{name} is {given!r}; allowed: a list of {allowed}")
    for x in given:
        if not isinstance(x, kinds):
            raise InputError(f"{name} has {x!r}; allowed: {allowed}")
    return list(given)


def parameter(name: str, given: ArrayLike | Tensor) -> nn.Parameter:
    """A parameter as it is, or numbers of any shape as one of their own; InputError for anything that is computed."""
    if not isinstance(given, nn.Parameter):
        refuse_gradients(
            name, given, "numbers; a torch.nn.Parameter, registered as it is; of a computed x, " + _COMPUTED
        )
        return nn.Parameter(reals(name, given))
    if given.dtype != torch.float64:
        raise InputError(f"{name} is a Parameter of {given.dtype}; allowed: torch.float64")
    return given


def _read(name: str, given: ArrayLike | Tensor, allowed: str) -> Tensor:
    refuse_gradients(name, given, allowed)
    try:
        x = (given.detach() if isinstance(given, Tensor) else torch.from_numpy(np.array(given))).clone()
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is {given!r}; allowed: {allowed}") from error
    if x.is_complex():
        raise InputError(f"{name} is {given!r}; allowed: {allowed}, real ones")
    return x
