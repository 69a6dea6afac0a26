"""Every method of torchdiffeq as an integrator, on the index-1 equations; see ode.py.

Checked in tests/contracts/test_integrators.py, tests/convergence/test_time_order.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from torchmbd.errors import InputError, unknown
from torchmbd.integrate.flow_stepper import FlowStepper, flow_of_size
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.ode import DEFAULTS, FIXED, first_step
from torchmbd.math.checked_numbers import is_whole
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


@dataclass(frozen=True)
class Torchdiffeq(Integrator):
    """A method of torchdiffeq, by its name.

    rtol, atol   tolerances of adaptive methods, for motion and sensitivities alike
    options      passed to torchdiffeq

    A method of fixed step makes one step in each output interval. Lanes are integrated together; where one cannot be
    integrated (its step size underflows), one by one.
    """

    rtol: float = 1e-7
    atol: float = 1e-9
    options: dict[str, Any] | None = None
    work: ClassVar[tuple[str, ...]] = ("rates",)
    adjoint: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for key in ("rtol", "atol"):
            x = getattr(self, key)
            if not isinstance(x, (int, float)) or isinstance(x, bool) or not 0.0 < x < 1.0:
                raise InputError(key, x, "positive and below 1")
        if self.options is not None and not isinstance(self.options, dict):
            raise InputError("options", self.options, "a mapping name -> value, options of torchdiffeq")
        allowed = options_of(self.name)
        for key, x in (self.options or {}).items():
            if key not in allowed:
                raise unknown(f"options of method {self.name!r}: option", key, allowed, ("options", key))
            good, words = allowed[key]
            if not good(x):
                raise InputError(("options", key), x, words, noun=f"options of method {self.name!r}: {key}")

    def stepper(self, dynamics: Dynamics, h: float) -> FlowStepper:
        return FlowStepper(dynamics, h, self.arguments)

    def step_of_size(self, dynamics: Dynamics, x: State, h: Any, t1: Any, near: State | None = None) -> State:
        return flow_of_size(dynamics, x, h, t1, self.arguments(dynamics))

    def arguments(self, dynamics: Dynamics) -> dict[str, Any]:
        """Arguments of torchdiffeq.odeint."""
        tolerances = {} if self.name in FIXED else {"rtol": self.rtol, "atol": self.atol}
        defaults = DEFAULTS.get(self.name, {}) if self.name in FIXED else first_step(dynamics)
        return {"method": self.name, "options": defaults | (self.options or {})} | tolerances


Allowed = tuple[Callable[[Any], bool], str]  # whether a value is, and what is


def options_of(method: str) -> Mapping[str, Allowed]:
    """Options of a method of torchdiffeq, which itself passes over what it does not know."""
    positive: Allowed = (lambda x: _number(x) and x > 0.0, "a positive number")
    count: Allowed = (lambda x: is_whole(x) and x >= 1, "a positive integer")
    times: Allowed = (lambda x: isinstance(x, torch.Tensor) and x.dim() == 1, "a tensor of times [s]")
    if method not in FIXED:
        names = ("first_step", "max_step", "safety", "ifactor", "dfactor")
        not_negative: Allowed = (lambda x: _number(x) and x >= 0.0, "zero or positive")
        rest = {"min_step": not_negative, "max_num_steps": count, "step_t": times, "jump_t": times}
        return dict.fromkeys(names, positive) | rest
    options: dict[str, Allowed] = {
        "step_size": positive,
        "grid_constructor": (callable, "a function (f, y0, t) -> times"),
        "interp": (lambda x: isinstance(x, str) and x in ("linear", "cubic"), "linear, cubic"),
        "perturb": (lambda x: isinstance(x, bool), "true or false"),
    }
    order: Allowed = (lambda x: is_whole(x) and 1 <= x <= 12, "1 to 12")
    return options | ({"max_order": order, "max_iters": count} if method.endswith("adams") else {})


def _number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and math.isfinite(x)
