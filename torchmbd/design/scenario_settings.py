"""Scenarios as a user states them: names, weights and values of parameters, checked; and how rows of scenarios are combined.

Checked in tests/design/test_scenarios.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError, Path
from torchmbd.integrate.arguments import of_allowed_sign
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.plausible_units import check_parameter
from torchmbd.multibody.system import System

SYSTEM = "system"  # key of a scenario
MAKE_PARAMETER = "mbd.variable(...), which makes a parameter of a plain number of a constructor"


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
        raise InputError("weights", weights, f"{count} numbers that are not negative, one for each scenario")
    if not sum(weights) > 0.0:
        state, allowed = "are all 0", "must have at least one positive weight"
        raise InputError("weights", weights, allowed, noun="weights of scenarios", state=state)
    return np.asarray(weights, dtype=float) / float(sum(weights))


def settings_of(
    system: System, variables: Sequence[str], place: str, settings: Mapping[str, Any], path: Path = ()
) -> dict[str, Tensor]:
    """The values that settings give to parameters of a system; InputError for one that cannot be set, or cannot have its value.

    variables  names of the design variables, which cannot be set
    place      words for the settings in messages: "in scenario 'heavy'"
    path       the keys to the settings
    """
    parameters, values = dict(system.named_parameters()), {}
    for name, setting in settings.items():
        if name == SYSTEM:
            continue
        if name not in parameters:
            noun, state = f"parameter {name!r} {place}", "does not exist"
            raise InputError((*path, name), setting, parameters, MAKE_PARAMETER, noun=noun, state=state)
        noun = f"{name} {place}"
        if name in variables:
            state, allowed = "is a design variable", "a parameter that is not a design variable"
            raise InputError((*path, name), setting, allowed, noun=noun, state=state)
        value = _value((*path, name), noun, setting, parameters[name].detach())
        good, allowed = of_allowed_sign(system, name, value)
        if not good.all():
            raise InputError((*path, name), setting, allowed, noun=noun)
        check_parameter(f"{place}:", name, value, (*path, name))
        values[name] = value
    return values


def _value(path: Path, noun: str, setting: Any, default: Tensor) -> Tensor:
    """The value of a parameter, in the shape of its `default`; `path`, `noun`: its keys, and the words for it."""
    try:
        value = torch.as_tensor(setting, dtype=default.dtype)
    except (TypeError, ValueError, RuntimeError):
        value = torch.full_like(default, torch.nan)
    if value.dim() == 1 and value.shape != default.shape:
        state, allowed = f"has {len(value)} values", f"must have {default.numel()}, or one number for all"
        raise InputError(path, setting, allowed, noun=noun, state=state)
    if value.shape not in (default.shape, torch.Size([])) or not torch.isfinite(value).all():
        allowed = f"finite numbers of shape {list(default.shape)}, or one for all"
        raise InputError(path, setting, allowed, noun=noun)
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
