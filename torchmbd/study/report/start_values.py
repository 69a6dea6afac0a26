"""The responses of a problem at the start design, with their limits and estimated errors: they show wrong units, inactive
constraints and steps that are too large.

    at the start design:
      minimize       max of |y displacement of jib|       0.119201 m   error -0.02 %
      at most 0.6    mass of boom + mass of jib           0.417514 kg
      at most 0.5    max of ply failure of boom           1.63182      error +0.3 %    violated

Checked in tests/study/report/test_start_values.py.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from torchmbd.design import Problem
from torchmbd.design.problem_parts import governing_row
from torchmbd.design.words import unit, words
from torchmbd.optimization.api import FEASIBILITY
from torchmbd.results.response_error import ResponseError, rows_of

_FAR = 1e3  # factor between a value and its limit from which on they have hardly the same unit
_PLAIN: Any = {"markup": False, "highlight": False, "soft_wrap": True}
_IDLE = 1e-9  # share of the limit below which a value counts as zero


class Value(NamedTuple):
    """A response at the start design.

    goal   "minimize", or the limit
    unit   None: unknown
    note   on the value
    error  estimated, over the size of an objective, or the larger of size and margin of a constraint; 0.0: none, or not
           estimated; nan: not resolved
    """

    goal: str
    words: str
    value: float
    unit: str | None
    note: str
    error: float = 0.0


def start_values(problem: Problem, criteria: int = 1, errors: Sequence[ResponseError] = ()) -> list[Value] | str:
    """Return the responses at the start design, of constraints the row nearest to its limit; or why it fails.

    criteria  of a front; all but the first are the first constraints of the problem
    errors    of the objective and of every constraint at the start design; none: they are not estimated
    """
    [evaluation] = problem.evaluate(problem.start[None], False)
    if not evaluation.ok:
        return evaluation.status
    what, value = "minimize", evaluation.objective
    if problem.sign < 0.0:
        what, value = "maximize", -value
    factor, name = _shown(unit(problem.stated_objective))
    shares = _error_shares(problem, errors)
    values = [Value(what, words(problem.stated_objective), factor * value, name, "", shares[0])]
    constraints = evaluation.constraints[problem.peaks :]
    for constraint, rows, share in zip(problem.constraints, problem.constraint_rows, shares[1:], strict=True):
        c, limits, scales = constraints[rows], problem.limits[rows], problem.reference.scale[rows]
        worst = int(governing_row(constraint, c))
        limit, value = float(limits[worst]), float(limits[worst] + c[worst] * scales[worst])
        violation = abs(c[worst]) if constraint.kind == "equal" else c[worst]
        note = "violated" if violation > FEASIBILITY else ""
        if limit and constraint.limit != "initial":
            note = _implausible(value, limit, constraint.kind) or note
        factor, name = _shown(unit(constraint.measure))
        if len(values) < criteria:
            values.append(Value("minimize", words(constraint.measure), factor * value, name, "", share))
            continue
        text = "initial" if constraint.limit == "initial" else f"{factor * limit:.6g}"
        kind = "equal to" if constraint.kind == "equal" else constraint.kind.replace("_", " ")
        values.append(Value(f"{kind} {text}", words(constraint.measure), factor * value, name, note, share))
    return values


def _error_shares(problem: Problem, errors: Sequence[ResponseError]) -> list[float]:
    """Return the errors of objective and constraints as shares: of their sizes or margins; zeros if none are estimated."""
    if not errors:
        return [0.0] * (1 + len(problem.constraints))
    sizes = [rows_of(error.size).numpy()[0] for error in errors]
    margins = [
        abs(problem.limits[rows] - rows_of(e.value).numpy()[0])
        for rows, e in zip(problem.constraint_rows, errors[1:], strict=True)
    ]
    sizes = [np.full_like(sizes[0], sizes[0].max()), *map(np.maximum, sizes[1:], margins)]
    shares = []
    for error, size in zip(errors, sizes, strict=True):
        rows = rows_of(error.by_steps).numpy()[0]
        worst = int(np.argmax(abs(rows)))
        size = size[worst]
        shares.append(math.nan if not error.resolved.all() else float(rows[worst] / size) if rows[worst] else 0.0)
    return shares


def worst_share(values: Sequence[Value]) -> float:
    """Return the size of the largest error of the responses, a share; nan where one is not resolved."""
    sizes = [abs(value.error) for value in values]
    return math.nan if any(map(math.isnan, sizes)) else max(sizes)


def _shown(si: str | None) -> tuple[float, str | None]:
    """Return the factor to the unit in which a response is printed, and this unit: degrees for angles."""
    return (math.degrees(1.0), "deg") if si == "rad" else (1.0, si)


def _implausible(value: float, limit: float, kind: str) -> str:
    """Return a note on a value that is hardly meant with such a limit, "" for others."""
    if abs(value) < _IDLE * abs(limit):
        return "is zero: is it what is meant?"
    if abs(value) > _FAR * abs(limit):
        return "violated; units?" if (value > limit) == (kind != "at_least") else "far from its limit: units?"
    if abs(value) * _FAR < abs(limit):
        return "far from its limit: units?"
    return ""


def print_start_values(values: list[Value] | str, console: Console) -> None:
    """Print the responses at the start design, or why it cannot be simulated."""
    if isinstance(values, str):
        console.print(f"the start design {values}", markup=False, soft_wrap=True)
        return
    console.print("at the start design:", markup=False)
    rows = [
        (
            f"  {value.goal}",
            value.words,
            f"{value.value:.6g} {value.unit or ''}".rstrip(),
            _error_text(value.error),
            value.note,
        )
        for value in values
    ]
    goal, _, number, error, note = (max(map(len, column)) for column in zip(*rows, strict=True))
    width = max(console.width - goal - number - error - note - 8, 16)
    for row in rows:
        lines = textwrap.wrap(row[1], width)
        wide = min(width, max(len(value.words) for value in values))
        told = f"{row[0]:<{goal}}  {lines[0]:<{wide}}  {row[2]:<{number}}  {row[3]:<{error}}  {row[4]}"
        console.print(told.rstrip(), **_PLAIN)
        for line in lines[1:]:
            console.print(" " * (goal + 2) + line, **_PLAIN)


def _error_text(share: float) -> str:
    return "not resolved" if math.isnan(share) else f"error {100.0 * share:+.1g} %" if share else ""
