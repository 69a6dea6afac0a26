"""Errors of responses by the steps of a motion: the same motion with finer steps, and Richardson's extrapolation.

    error = (v_half - v) 4/3        of methods of second order: v = true + c h^2 + ..., v_half = true + c h^2/4 + ...
    error = v_tight - v             of adaptive methods: tolerances a hundredth, twice the outputs

Where the difference is large, or the status of the lane is not "ok", a third motion with a quarter of the step shows
whether the error falls as it should: by four, accepted from two to eight;
of tolerances, at least by two.
Source: Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357.
Checked in tests/design/test_response_errors.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.results.motion_data import OK

_LARGE = 0.1  # of the value: from there on the third motion is made
_ROUNDING = 1e-10  # of the value: differences that are rounding and the residuals of Newton's iterations
_LEAST, _MOST = 2.0, 8.0  # of the reduction of the error by half the step; four for second order


@dataclass(frozen=True)
class ResponseError:
    """The error of a response by the steps of its motion.

    name      of the response
    value     of the motion [lanes] or [lanes, rows], in the unit of the response
    by_steps  estimated true value minus value, of the same shape and unit
    resolved  whether the estimate holds [lanes]: the error falls with the steps as the method promises
    reasons   why a lane is not resolved, "" where it is
    note      what the estimate is worth for this kind of response, "" where there is nothing to say

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> error = motion.error_of(mbd.Final(mbd.Angle("bob", "z")))
    >>> error.resolved.tolist(), bool(error.by_steps.abs() < 1e-3)  # [rad]
    ([True], True)
    """

    name: str
    value: Tensor
    by_steps: Tensor
    resolved: Tensor
    reasons: tuple[str, ...]
    note: str = ""

    def __str__(self) -> str:
        """A line for each lane."""
        lines = []
        for lane, reason in enumerate(self.reasons):
            values, errors = (x[lane].reshape(-1).tolist() for x in (self.value, self.by_steps))
            pairs = ", ".join(f"{v:.6g} (error by steps {e:+.2g})" for v, e in zip(values, errors, strict=True))
            lines.append(f"{self.name}: {pairs}" + (f", not resolved: {reason}" if reason else ""))
        return "\n".join(lines) + (f"\n({self.note})" if self.note else "")


def response_error(motion: Any, response: Callable[[Any], Tensor]) -> ResponseError:
    """The error of a response by the steps of its motion; InputError for what has no estimate."""
    if not callable(response):
        raise InputError(f"response is {response!r}; allowed: a measure, such as mbd.Max(...)")
    if motion.simulation is None:
        raise InputError("this motion is a part of another; allowed: error_of of the motion that simulate returns")
    with torch.no_grad():
        value = _numbers(response, motion)
        half = motion.finer(2)
        order, finer = motion.simulation.order, _numbers(response, half)
        if finer.shape != value.shape:
            raise InputError(
                f"response {response!r} has numbers {list(value.shape)}, with finer steps {list(finer.shape)}; "
                "allowed: numbers that do not change with the steps, such as mbd.Max(...) of a history"
            )
        remainder = 1.0 / (2.0**order - 1.0) if order else 0.0  # of the finer value, over the difference
        first = finer - value
        error = first * (1.0 + remainder)
        rounding = _ROUNDING * value.abs().maximum(finer.abs())
        sound = torch.tensor([status == OK for status in motion.status])
        doubtful = (
            ~(rows_of(first).abs() <= _LARGE * rows_of(value).abs().maximum(rows_of(finer).abs())).all(1) | ~sound
        )
        reasons = [""] * motion.lanes
        if doubtful.any():
            quarter = motion.finer(4)
            finest = _numbers(response, quarter)
            second = finest - finer
            better = finest - value + second * remainder
            error = torch.where(doubtful.reshape(-1, *[1] * (value.ndim - 1)), better, error)
            ratio = first / second
            falls = (ratio >= _LEAST) & (ratio <= _MOST) if order else ratio.abs() >= _LEAST
            falls = rows_of(falls | (first.abs() <= rounding))
            for lane in doubtful.nonzero().flatten().tolist():
                reasons[lane] = _reason([m.status[lane] for m in (half, quarter)], falls[lane], rows_of(ratio)[lane])
        for lane in range(motion.lanes):
            if not reasons[lane] and not error[lane].isfinite().all():
                reasons[lane] = "the response has no number, here or with finer steps"
    resolved = torch.tensor([not reason for reason in reasons])
    note = "; ".join(dict.fromkeys(_notes(response)))
    return ResponseError(repr(response), value, error, resolved, tuple(reasons), note)


def rows_of(x: Tensor) -> Tensor:
    """Numbers [lanes, ...] as [lanes, rows]."""
    return x.reshape(len(x), -1)


def _numbers(response: Callable[[Any], Tensor], motion: Any) -> Tensor:
    x = response(motion)
    if not isinstance(x, Tensor) or not x.ndim or len(x) != motion.lanes:
        raise InputError(f"response {response!r} returns {x!r}; allowed: a tensor [lanes] or [lanes, rows]")
    return x.detach()


def _notes(response: Any) -> list[str]:
    """What the estimates of a measure and of the measures that it combines are worth."""
    notes = [str(getattr(response, "error_note", ""))]
    return [note for note in notes if note] + [n for part in getattr(response, "operands", ()) for n in _notes(part)]


def _reason(statuses: list[str], falls: Tensor, ratio: Tensor) -> str:
    """Why a lane with a large difference is not resolved; "" where the third motion confirms the estimate."""
    failed = next((status for status in statuses if status != OK), None)
    if failed is not None:
        return f"with finer steps the motion is {failed}"
    if falls.all():
        return ""
    worst = ratio[~falls][0].item()
    return f"half the step changes the error by a factor of {worst:.2g}, expected 4; use more steps"
