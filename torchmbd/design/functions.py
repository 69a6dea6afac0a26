"""Functions of the motion that a user writes, as histories and measures.

    @mbd.history
    def reach(motion):
        return motion.body("rod").at("right").position.norm(dim=-1)

The functions use torch operations; gradients are computed as for every response (response.py).
Checked in tests/contracts/test_responses.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, overload

import torch
from torch import Tensor

from torchmbd.design.response import History, Measure
from torchmbd.diagnosis.response_error import change_by_motion
from torchmbd.errors import InputError, warn
from torchmbd.integrate import Trajectory
from torchmbd.math.gradients import refuse_lost_gradients


@dataclass(frozen=True)
class FunctionHistory(History):
    """A function of the motion as a history; `history` returns it."""

    function: Callable[[Any], Tensor]
    unit: str | None = None

    def __repr__(self) -> str:
        return f"history({_name(self.function)})"

    @property
    def natural_zero(self) -> bool:
        return False  # not known of a function

    def values(self, motion: Trajectory) -> Tensor:
        return _checked_call(self.function, motion, (motion.lanes, len(motion.t)))


@dataclass(frozen=True)
class FunctionMeasure(Measure):
    """A function of the motion as a measure; `measure` returns it."""

    function: Callable[[Any], Tensor]
    unit: str | None = None

    def __repr__(self) -> str:
        return f"measure({_name(self.function)})"

    @property
    def natural_zero(self) -> bool:
        return False  # not known of a function

    def value(self, motion: Trajectory) -> Tensor:
        return _checked_call(self.function, motion, (motion.lanes,))

    def change(self, motion: Trajectory) -> Tensor:
        return change_by_motion(self.value, motion)


# What torch says where NumPy asks for a tensor with a gradient, or for one inside a transform.
NUMPY_ERRORS = ("numpy", "data pointer")


def _name(function: Callable[..., Any]) -> str:
    inner = function.func if isinstance(function, partial) else function
    return getattr(inner, "__name__", type(inner).__name__)


def _callable(function: Callable[[Any], Tensor]) -> Callable[[Any], Tensor]:
    if not callable(function) or isinstance(function, (History, Measure)):
        raise InputError("function", function, "a function of a motion")
    return function


def _unit(unit: str | None) -> str | None:
    if unit is not None and not isinstance(unit, str):
        raise InputError("unit", unit, "the name of an SI unit, such as 'N'")
    return unit


def _checked_call(function: Callable[[Any], Tensor], motion: Trajectory, shape: tuple[int, ...]) -> Tensor:
    """The result of a user's function of a motion; InputError unless it has the required shape."""
    name = _name(function)
    try:
        result = function(motion)
    except (RuntimeError, TypeError) as error:
        if not any(text in str(error) for text in NUMPY_ERRORS):
            raise
        raise InputError(
            ("response", name),
            allowed="must use operations of torch, such as torch.maximum for np.maximum, without .numpy()",
            state="makes NumPy numbers of a motion that is differentiated",
            noun=f"response {name!r}",
        ) from error
    if not isinstance(result, Tensor) or result.shape != shape or not result.is_floating_point():
        returned = f"shape {tuple(result.shape)} of {result.dtype}" if isinstance(result, Tensor) else repr(result)
        raise InputError(
            ("response", name),
            allowed=f"must return a tensor of shape {shape}, real numbers",
            state=f"returned {returned}",
            noun=f"response {name!r}",
        )
    if motion.integration is not None:  # parts of a motion are given to functions that were called on the whole motion
        with torch.inference_mode(False), torch.enable_grad():
            refuse_lost_gradients(("response", name), function(motion.detach()), "constant tensors")
    if torch.is_grad_enabled() and motion.q.requires_grad and not result.requires_grad:
        warn(
            f"response {name!r} has a gradient of zero, because torch operations do not connect its result with the motion. "
            "float(), .item(), .numpy() and .detach() cut the gradient. Try: torch operations alone"
        )
    return result


@overload
def history(function: Callable[[Any], Tensor], unit: str | None = None) -> History: ...
@overload
def history(function: None = None, unit: str | None = None) -> Callable[[Callable[[Any], Tensor]], History]: ...
def history(function: Any = None, unit: str | None = None) -> Any:
    """Make a history from a function of the motion.

    function  motion -> [lanes, times] in any unit, of torch operations, which give its gradient. Numbers that leave
              torch (detach, numpy, float) have no gradient
    unit      SI unit of the values, for figures and tables, such as "N", or "rad" of an angle: @mbd.history(unit="N")

    The function is called for one design and for a batch. torchmbd/results/trajectory.py lists the attributes of a
    motion. A call raises InputError if the function returns another shape.

    >>> @mbd.history
    ... def reach(motion):
    ...     return motion.body("tool").at((0, 0, 0)).position[..., 0]  # [m]
    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> round(mbd.Max(reach)(motion).item(), 3)
    0.5
    """
    if function is None:
        return partial(history, unit=unit)
    return FunctionHistory(_callable(function), _unit(unit))


@overload
def measure(function: Callable[[Any], Tensor], unit: str | None = None) -> Measure: ...
@overload
def measure(function: None = None, unit: str | None = None) -> Callable[[Callable[[Any], Tensor]], Measure]: ...
def measure(function: Any = None, unit: str | None = None) -> Any:
    """Make a measure from a function of the motion.

    function  motion -> [lanes], any unit, of torch operations, as for `history`
    unit      SI unit of the values, such as "J": @mbd.measure(unit="J")

    A call raises InputError if the function returns another shape.

    >>> @mbd.measure
    ... def spread(motion):
    ...     return motion.body("arm").strain_energy.std(dim=-1)  # [J]
    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> value, gradient = spread.value_and_gradient(motion)
    >>> value.shape, gradient.shape
    (torch.Size([1]), torch.Size([1, 2]))
    """
    if function is None:
        return partial(measure, unit=unit)
    return FunctionMeasure(_callable(function), _unit(unit))
