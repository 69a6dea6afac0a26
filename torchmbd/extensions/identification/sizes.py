"""Sizes of measured numbers beside those of the model at the start: a wrong unit is a factor such as 57 or 1,000.

Sizes are spreads about the mean, so that no origin counts; of fewer than three numbers, and of equal ones, root mean squares.
Checked in tests/extensions/identification/test_sizes.py.
"""

from __future__ import annotations

import numpy as np

from torchmbd.extensions.identification.fit_problem import LEAST_SPREAD, FitProblem
from torchmbd.extensions.identification.measurement import unit_of_title
from torchmbd.math.units import UNITS, units_of

LARGE = 10.0  # a model at the start is seldom as far from the data
NEAR = 1.5  # times the factor of a unit, which is named then


def size_doubts(problem: FitProblem, shown: np.ndarray) -> list[str]:
    """A sentence for each channel whose numbers are much larger or smaller than those of the model [data]."""
    result = []
    for row in problem.rows:
        if problem.has_unknown_gain(row):
            continue
        measured, model = _size(row.block.measured), _size(shown[row.rows])
        if not measured or not model or 1.0 / LARGE < measured / model < LARGE:
            continue
        result.append(
            f"channel {row.name!r}: the measured numbers are {_words(measured / model, unit_of_title(row.block.title))}. "
            "Try: the unit of the column, or of the times, by unit= or in the brackets of its heading; or another start"
        )
    return result


def _words(ratio: float, si: str) -> str:
    """Measured numbers over those of the model in words, with the unit whose factor is nearest, if one is near."""
    base = si.replace("²", "2")
    factors = {f"in {unit} that are read as {si}": 1.0 / UNITS[unit][0] for unit in units_of(base)}
    factors |= {f"in {si} that are read as {unit}": UNITS[unit][0] for unit in units_of(base)}
    text = min(factors, key=lambda x: abs(np.log(factors[x] / ratio)), default="")
    near = bool(text) and abs(np.log(factors[text] / ratio)) < np.log(NEAR)
    times = factors[text] if near else ratio
    number = f"{float(f'{max(times, 1.0 / times):.2g}'):,.0f} times {'larger' if times > 1.0 else 'smaller'}"
    return f"{number} than those of the model at the start" + (f", as numbers {text} are" if near else "")


def _size(y: np.ndarray) -> float:
    spread, rms = float(np.std(y)), float(np.sqrt(np.mean(y**2)))
    return spread if len(y) > 2 and spread > LEAST_SPREAD * rms else rms
