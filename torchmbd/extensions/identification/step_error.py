"""How far the steps of motions move the unknowns of a fit, beside their deviations.

    e = (y_finer - y) / (1 - 1/r^2) / deviation     error of the model's numbers by its steps, r = 2.3 times as many
    shift = -(J'J)^+ J' e                           unknowns of a model without this error, minus those of the fit        [n]

The two numbers of steps share no factor, as a load whose period divides a step would show one value in both motions.
An error below the noise of every number can move an unknown by many of its deviations: the noise of many numbers averages out,
the error of the model does not. Steps that an experiment leaves open are made finer until all unknowns move by less than SHARE
of their deviations; steps that are given are judged.

Checked in tests/extensions/identification/test_step_error.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

SHARE = 0.25  # of the deviation of an unknown, which a step may move it: the interval of 95 % then holds 94 %
_MORE = 1.1  # times the steps that the error asks for
_MOST_FINER = 4  # times the steps before
_LEAST = 1e-6  # of the size of an unknown: a smaller shift does not count, whatever the deviation
MOST, MOST_STEPS = 16, 100_000  # times the first steps; steps


@dataclass(frozen=True)
class StepError:
    """What the steps do to the unknowns.

    shift      of the unknowns [n], in their units: how far those of a model without errors by steps are away
    share      of the deviations [n], of all experiments together
    shares     largest share of an unknown, by experiment
    unknown    experiment -> why its error is not known
    """

    shift: np.ndarray
    share: np.ndarray
    shares: Mapping[str, float]
    unknown: Mapping[str, str] = field(default_factory=dict)

    @property
    def meets(self) -> bool:
        """True if every unknown moves by less than SHARE of its deviation."""
        return bool((self.share <= SHARE).all())


def step_error(
    errors: Mapping[str, tuple[slice, np.ndarray]],
    unknown: Mapping[str, str],
    moves: np.ndarray,
    deviation: np.ndarray,
    size: np.ndarray,
) -> StepError:
    """The shifts of unknowns.

    errors     experiment -> its rows, and true minus predicted numbers in deviations [rows of it]
    moves      of the unknowns by residuals [n, all rows] (statistics.py);  deviation, size: of the unknowns [n]
    """
    shifts = {name: -moves[:, rows] @ e for name, (rows, e) in errors.items()}
    total = sum(shifts.values(), np.zeros(len(moves)))
    unit = np.maximum(deviation, _LEAST * size / SHARE)

    def share(shift: np.ndarray) -> np.ndarray:
        return np.divide(np.abs(shift), unit, out=np.zeros_like(unit), where=unit > 0.0)

    shares = {name: float(share(x).max(initial=0.0)) for name, x in shifts.items()}
    return StepError(total, share(total), shares, unknown)


def finer_steps(steps: Mapping[str, int], first: Mapping[str, int], error: StepError) -> dict[str, int]:
    """More steps for experiments whose errors move unknowns too far, a multiple of theirs; none: the limit is reached."""
    limit = SHARE / max(1, len(error.shares))
    result = {}
    for name, n in steps.items():
        share = error.shares.get(name, 0.0)
        if share <= limit:
            continue
        factor = min(max(2, math.ceil(math.sqrt(_MORE * share / limit))), _MOST_FINER)
        if factor * n <= min(MOST * first[name], max(MOST_STEPS, first[name])):
            result[name] = factor * n
    return result


def sentence(error: StepError, names: list[str], steps: Mapping[str, int | None]) -> str:
    """What a user must know of the steps; "" where they do nothing."""
    if error.unknown:
        name, reason = next(iter(error.unknown.items()))
        return f"the error by the steps of {name!r} is not known: {reason}"
    if error.meets:
        return ""
    far = np.flatnonzero(error.share > SHARE)
    far = far[np.argsort(-error.share[far])]
    listed = ", ".join(f"{names[k]} by {error.share[k]:.2g}" for k in far[:3]) + (", ..." if len(far) > 3 else "")
    counts = ", ".join(str(steps[name]) for name in error.shares)
    return (
        f"{counts} steps: their error moves unknowns, in standard deviations: {listed}. The intervals do not include this "
        "error. Try: more steps="
    )
