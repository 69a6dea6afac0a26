"""Scenarios as a user states them: names, weights and values of parameters, checked; and how rows of scenarios are combined.

Checked in tests/design/test_scenarios.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError, nearest
from torchmbd.integrate.arguments import of_allowed_sign
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.plausible_units import check_parameter
from torchmbd.multibody.system import System

SYSTEM = "system"  # key of a scenario


def scenarios_by_name(scenarios: Any) -> Any:
    """The scenarios as name -> settings; scenarios of a list have the names "scenario 1", "scenario 2", ..."""
    if isinstance(scenarios, Sequence) and not isinstance(scenarios, str):
        return {f"scenario {k + 1}": settings for k, settings in enumerate(scenarios)}
    return scenarios


def normalized_weights(weights: Any, count: int) -> np.ndarray:
    """Weights of `count` scenarios [count], divided by their sum; None: equal weights. InputError for other values."""
    if weights is None:
        return np.full(count, 1.0 / count)
    if (
        not isinstance(weights, (Sequence, np.ndarray))
        or len(weights) != count
        or not all(map(is_real, weights))
        or min(weights) < 0
    ):
        raise InputError(
            f"weights is {weights!r}; allowed: {count} numbers that are not negative, one for each scenario"
        )
    if not sum(weights) > 0.0:
        raise InputError("weights of scenarios are all 0; allowed: one at least that is positive")
    return np.asarray(weights, dtype=float) / float(sum(weights))


def settings_of(
    system: System, variables: Sequence[str], scenario: str, settings: Mapping[str, Any]
) -> dict[str, Tensor]:
    """The values of the parameters of a system that a scenario sets; InputError for one that it cannot set, or cannot have.

    variables  names of the design variables, which no scenario sets
    """
    parameters, values = dict(system.named_parameters()), {}
    for name, setting in settings.items():
        if name == SYSTEM:
            continue
        if name not in parameters:
            hint = "a plain number of a constructor becomes a parameter by mbd.variable(...)"
            raise InputError(f"parameter of a scenario {name!r} does not exist{nearest(name, parameters)}; {hint}")
        if name in variables:
            raise InputError(f"scenarios set {name!r}, a design variable; allowed: parameters that are none")
        value = _value(f"{name} in scenario {scenario!r}", setting, parameters[name].detach())
        good, allowed = of_allowed_sign(system, name, value)
        if not good.all():
            raise InputError(f"{name} in scenario {scenario!r} is {setting!r}; allowed: {allowed}")
        check_parameter(f"scenario {scenario!r} sets", name, value)
        values[name] = value
    return values


def _value(what: str, setting: Any, default: Tensor) -> Tensor:
    """The value of a parameter, in the shape of its `default`."""
    try:
        value = torch.as_tensor(setting, dtype=default.dtype)
    except (TypeError, ValueError, RuntimeError):
        value = torch.full_like(default, torch.nan)
    if value.dim() == 1 and value.shape != default.shape:
        raise InputError(f"{what} has {len(value)} values; allowed: {default.numel()}, or one number for all")
    if value.shape not in (default.shape, torch.Size([])) or not torch.isfinite(value).all():
        allowed = f"finite numbers of shape {list(default.shape)}, or one for all"
        raise InputError(f"{what} is {setting!r}; allowed: {allowed}")
    return value.detach().expand(default.shape)


def combined(
    rule: str, values: np.ndarray, slopes: np.ndarray | None, weights: np.ndarray, lower_limit: bool
) -> tuple[np.ndarray, np.ndarray | None]:
    """Rows and gradients of a measure over all scenarios, from those in each scenario.

    rule         "each": the rows of all scenarios [lanes, scenarios * rows]; "mean": their weighted means [lanes, rows];
                 "worst": each row in the scenario where it is largest, or smallest for a lower limit [lanes, rows]
    values       [lanes, scenarios, rows]
    slopes       [lanes, scenarios, rows, n], or None
    weights      of the scenarios, of sum one [scenarios]
    """
    lanes, scenarios, rows = values.shape
    if rule == "each":
        return values.reshape(lanes, -1), None if slopes is None else slopes.reshape(lanes, scenarios * rows, -1)
    if rule == "mean":
        mean = np.einsum("s,ls...->l...", weights, values)
        return mean, None if slopes is None else np.einsum("s,ls...->l...", weights, slopes)
    worst = np.argmax(-values if lower_limit else values, 1)[:, None]
    rows_of_worst = np.take_along_axis(values, worst, 1)[:, 0]
    return rows_of_worst, None if slopes is None else np.take_along_axis(slopes, worst[..., None], 1)[:, 0]
