"""What a caller gives of scenarios: names, weights, values of parameters, each checked.

Checked in tests/design/test_scenarios.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import is_real


def by_name(given: Any) -> Any:
    """A list of scenarios by names."""
    if isinstance(given, Sequence) and not isinstance(given, str):
        return {f"scenario {k + 1}": settings for k, settings in enumerate(given)}
    return given


def weights_of(given: Any, count: int) -> np.ndarray:
    """Weights of `count` scenarios in means [count], of sum one; InputError for what are none."""
    if given is None:
        return np.full(count, 1.0 / count)
    if (
        not isinstance(given, (Sequence, np.ndarray))
        or len(given) != count
        or not all(map(is_real, given))
        or min(given) < 0
    ):
        raise InputError(f"weights is {given!r}; allowed: {count} numbers that are not negative, one for each scenario")
    if not sum(given) > 0.0:
        raise InputError(f"weights is {given!r}; allowed: one that is positive at least")
    return np.asarray(given, dtype=float) / float(sum(given))


def value_of(scenario: str, name: str, given: Any, own: Tensor) -> Tensor:
    """The value of a parameter in a scenario; its own where the scenario says nothing."""
    if given is None:
        return own
    try:
        value = torch.as_tensor(given, dtype=own.dtype)
    except (TypeError, ValueError, RuntimeError):
        value = torch.full_like(own, torch.nan)
    if value.shape not in (own.shape, torch.Size([])) or not torch.isfinite(value).all():
        raise InputError(
            f"{name} in scenario {scenario!r} is {given!r}; allowed: finite numbers of shape {list(own.shape)}, or one for all"
        )
    return value.detach().expand(own.shape)
