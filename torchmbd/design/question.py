"""What a problem asks for: its objective with its sign, its constraints, and the numbers that refer to the initial design.

Checked in tests/design/test_problem.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from torchmbd.design.response import Constraint, Measure
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import list_of


class Reference(NamedTuple):
    """The problem with everything that refers to the initial design filled in.

    measures  objective, then one for each constraint
    unit      what the extra variable is a multiple of
    limits    c of every row of the constraints [m]
    scale     what the violation of each row is divided by, with the sign of its kind [m]
    """

    measures: list[Measure]
    unit: float
    limits: np.ndarray
    scale: np.ndarray


def constraints_of(subject_to: Any) -> list[Constraint]:
    """A constraint, or a list of them, as a list; InputError names what is none."""
    given = [subject_to] if isinstance(subject_to, Constraint) else subject_to
    return list_of("subject_to", given, Constraint, "constraints, such as Max(...) <= 'initial'")


def asked_of(minimize: Any, maximize: Any) -> tuple[Measure, float]:
    """What is asked for, and its sign: -1 where it is to be large."""
    if minimize is not None and maximize is not None:
        raise InputError(f"minimize is {minimize!r} and maximize is {maximize!r}; allowed: one of them")
    if minimize is None and maximize is None:
        raise InputError("'minimize' of Problem is missing; allowed: a measure, here or as 'maximize'")
    name, measure = ("minimize", minimize) if maximize is None else ("maximize", maximize)
    if not isinstance(measure, Measure):
        raise InputError(f"{name} is {measure!r}; allowed: a measure, such as Integral(StrainEnergy('rod'))")
    if maximize is not None and measure.rows > 1:
        raise InputError(f"maximize is {measure!r}, of {measure.rows} rows; allowed: a measure of one number")
    return measure, 1.0 if maximize is None else -1.0


def largest(measure: Measure, motion: Trajectory) -> float:
    return float(measure.value(motion)[0].max())


def scale_of(constraint: Constraint, limit: float) -> float:
    """What the violation of a constraint is divided by, with the sign of its kind."""
    size = constraint.scale or abs(limit) or 1.0
    return -size if constraint.kind == "at_least" else size
