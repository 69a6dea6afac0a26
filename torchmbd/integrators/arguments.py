"""The door of `simulate`: arguments that are wrong are refused, with their name, value and what is allowed.

Checked in tests/integrators/test_simulate.py.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.integrators import ode
from torchmbd.numerics.owned import refuse_derivatives, whole
from torchmbd.numerics.plausible import check_parameter
from torchmbd.system import System

METHODS = ("generalized_alpha", *ode.METHODS)
Named = str | torch.device | None
DEVICES: dict[str, Callable[[], bool]] = {"cpu": lambda: True, "cuda": torch.cuda.is_available}  # type -> is there one


def check(duration: Any, method: Any, steps: Any, options: Mapping[str, Any], phases: bool = False) -> dict[str, Any]:
    """The options, without a device that is the CPU; InputError for arguments of `simulate` wrong for every system."""
    if not isinstance(duration, numbers.Real) or isinstance(duration, bool) or not 0 < float(duration) < math.inf:
        raise InputError(f"duration is {duration!r} s; allowed: a positive number")
    if steps is not None and not (whole(steps) and steps >= 1):
        raise InputError(f"steps is {steps!r}; allowed: a positive integer")
    if method == "scipy_solver":
        raise InputError(
            "method 'scipy_solver' returns gradients of zero in reverse mode, silently; allowed: any other"
        )
    if method not in METHODS:
        raise unknown("method", method, METHODS)
    options = on_device(options, method, phases)
    allowed = (
        ("spectral_radius", "iterations", "refresh", *(() if phases else ("halvings", "device")))
        if method == "generalized_alpha"
        else ("rtol", "atol", "options")
    )
    for name in options:
        if name not in allowed:
            raise unknown(f"for method {method!r} the option", name, allowed)
    return options


def on_device(options: Mapping[str, Any], method: str, phases: bool) -> dict[str, Any]:
    """Options with the name of a device that is there, none for the CPU; InputError for one that does not serve."""
    rest, name = {key: x for key, x in options.items() if key != "device"}, options.get("device")
    try:
        device = torch.device("cpu" if name is None else name) if isinstance(name, Named) else None
    except RuntimeError:  # torch knows no such name
        device = None
    there = [kind for kind, available in DEVICES.items() if available()]
    if device is None or device.type not in there:
        missing = "" if "cuda" in there else "; torch finds no CUDA device on this machine"
        raise InputError(f"device is {name!r}; allowed: {' or '.join(map(repr, there))}{missing}")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"device is {name!r}; allowed: 'cuda:0' to 'cuda:{torch.cuda.device_count() - 1}'")
    if device.type == "cpu":
        return rest
    if method != "generalized_alpha" or phases:
        what = "with phases" if phases else f"for method {method!r}"
        raise InputError(f"device is {name!r} {what}; allowed: method 'generalized_alpha' without phases, or 'cpu'")
    return rest | {"device": str(device)}


def check_adjoint(adjoint: Any, method: str, phases: bool, names: Sequence[str], device: Any = None) -> None:
    """Refuse adjoint=True where there is no way back; InputError says why."""
    if adjoint is not None and not isinstance(adjoint, bool):
        raise InputError(f"adjoint is {adjoint!r}; allowed: True, False or None")
    if not adjoint:
        return
    elsewhere = device not in (None, "cpu")
    if method != "generalized_alpha" or phases or elsewhere:
        found = "phases are given" if phases else f"method is {method!r}"
        found = f"device is {device!r}" if elsewhere else found
        raise InputError(f"adjoint is True, but {found}; allowed: method 'generalized_alpha' on the CPU without phases")
    if not names:
        raise InputError("adjoint is True, but sensitivities names no parameter; allowed: with sensitivities")


def check_designs(system: System, designs: Any) -> None:
    """Refuse designs that are not finite float64 numbers of the system's parameters; InputError names them."""
    own = dict(system.named_parameters())
    if not isinstance(designs, (Mapping, type(None))):
        raise InputError(f"designs is {designs!r}; allowed: parameter name -> tensor [lanes, ...]")
    for name, x in own.items():
        if name in (designs or {}):
            continue
        if not bool(torch.isfinite(x).all()):
            raise InputError(f"parameter {name!r} is {x.tolist()}; allowed: finite numbers")
        check_parameter("parameter", name, x)
    for name, x in (designs or {}).items():
        if name not in own:
            raise unknown("parameter", name, own)
        if not isinstance(x, Tensor) or x.dtype != torch.float64 or x.shape[1:] != own[name].shape or not len(x):
            found = f"has shape {tuple(x.shape)} of {x.dtype}" if isinstance(x, Tensor) else f"is {x!r}"
            shape = ", ".join(["lanes", *map(str, own[name].shape)])
            raise InputError(f"design {name!r} {found}; allowed: a float64 tensor [{shape}]")
        refuse_derivatives(f"design {name!r}", x, f"sensitivities=[{name!r}]")
        for lane in torch.nonzero(~torch.isfinite(x.reshape(len(x), -1)).all(1)).flatten().tolist():
            raise InputError(f"design {name!r} of lane {lane} is {x[lane].tolist()}; allowed: finite numbers")
        lane = int(x.detach().reshape(len(x), -1).abs().amax(1).argmax())
        check_parameter(f"design of lane {lane}:", name, x[lane])
        owner, _, own_name = name.rpartition(".")
        if own_name in getattr(system.get_submodule(owner), "positive", ()) and not bool((x > 0.0).all()):
            lane = int(torch.nonzero(~(x.reshape(len(x), -1) > 0.0).all(1))[0])
            raise InputError(f"design {name!r} of lane {lane} is {x[lane].tolist()}; allowed: positive numbers")


def check_sensitivities(system: System, sensitivities: Any) -> list[str]:
    """Names of the parameters whose sensitivities are asked for; InputError names what is wrong."""
    own = dict(system.named_parameters())
    if sensitivities is True:
        names = [name for name, x in own.items() if x.requires_grad]
        if not names:
            raise InputError("sensitivities=True, but no parameter of the system requires a gradient")
        return names
    if sensitivities is False or sensitivities is None:
        return []
    if isinstance(sensitivities, str) or not isinstance(sensitivities, Sequence):
        raise InputError(f"sensitivities is {sensitivities!r}; allowed: True, False or a list of names of parameters")
    for name in sensitivities:
        if name not in own:
            raise unknown("parameter", name, own)
    return list(sensitivities)
