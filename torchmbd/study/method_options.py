"""Options of methods: the keys of `simulate` and `optimizer` that are not in the schema of experiment files.

Names and types come from the fields of integrators and the signatures of optimizers; ranges are checked by the methods.
Checked in tests/study/test_load.py, test_malformed.py.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from torchmbd.errors import nearest
from torchmbd.integrate.registry import INTEGRATORS
from torchmbd.optimization import OPTIMIZERS
from torchmbd.optimization.multistart import multistart
from torchmbd.optimization.pareto import pareto_front
from torchmbd.study.file_errors import Fault, shown
from torchmbd.study.schema import Motion, Optimizer


def method_faults(sections: Mapping[str, Any]) -> list[Fault]:
    """Return the faults of the options of methods: unknown names, and values of a wrong type."""
    faults: list[Fault] = []
    simulation: Motion | None = sections.get("simulate")
    if simulation is not None:
        types = INTEGRATORS[simulation.method].option_types()
        faults += _faults("simulate", simulation.method, simulation, types)
    optimizer: Optimizer | None = sections.get("optimizer")
    if optimizer is not None:
        types, search = {}, pareto_front if sections.get("tradeoff") is not None else multistart
        for function in (search, OPTIMIZERS[optimizer.name]):
            types |= _option_types(function)
        faults += _faults("optimizer", optimizer.name, optimizer, types)
    return faults


def search_options(front: Callable[..., Any] | None = None) -> list[str]:
    """Return the options that all methods share: of `multistart`, or of the function that finds fronts."""
    arguments = {"problem", "method", "starts", "callback", "ended", "max_iterations", "options", "progress"}
    return [name for name in inspect.signature(front or multistart).parameters if name not in arguments]


def _option_types(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the types of the options of a search or a method by name."""
    hints = get_type_hints(function)
    parameters = inspect.signature(function).parameters.values()
    options = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY or p.name == "divisions"]
    return {name: hints.get(name, Any) for name in options}


def _faults(section: str, method: str, keys: Motion | Optimizer, types: Mapping[str, Any]) -> list[Fault]:
    faults = []
    for key, value in keys.options.items():
        if key not in types:
            known = nearest(key, dict.fromkeys([*type(keys).model_fields, *sorted(types)]))
            faults.append(Fault((section, key), f"unknown key for method {method!r}{known} (given: {shown(value)})"))
        elif text := _misfit(value, types[key]):
            faults.append(Fault((section, key), f"= {shown(value)}: {text}"))
    return faults


def _misfit(value: Any, type_: Any) -> str | None:
    """Return why a value of a file is not of a type, None if it is; a list may be a tuple, a text is no number."""
    try:
        TypeAdapter(type_).validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        messages = [details["msg"].replace("Input should", "must") for details in error.errors(include_url=False)]
        return "; or ".join(dict.fromkeys(messages))
    return None
