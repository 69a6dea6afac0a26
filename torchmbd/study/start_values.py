"""The responses of a problem at the start design, with their limits: they show wrong units and inactive constraints.

    at the start design:
      minimize       max of |y displacement of jib|       0.119201 m
      at most 0.6    mass of boom + mass of jib           0.417514 kg
      at most 0.5    max of ply failure of boom           1.63182        violated

Checked in tests/study/test_start_values.py.
"""

from __future__ import annotations

import math
import textwrap
from typing import Any, NamedTuple

from rich.console import Console

from torchmbd.design import Problem
from torchmbd.design.problem_parts import governing_row
from torchmbd.design.words import unit, words
from torchmbd.optimization.api import FEASIBILITY

_FAR = 1e3  # factor between a value and its limit from which on they have hardly the same unit
_PLAIN: Any = {"markup": False, "highlight": False, "soft_wrap": True}
_IDLE = 1e-9  # share of the limit below which a value counts as zero


class Value(NamedTuple):
    """A response at the start design: goal or limit, words, value, unit (None: unknown), and a note on the value."""

    asked: str
    words: str
    value: float
    unit: str | None
    note: str


def start_values(problem: Problem, criteria: int = 1) -> list[Value] | str:
    """Return the responses at the start design, of constraints the row nearest to its limit; or why it fails.

    criteria  of a front; all but the first are the first constraints of the problem
    """
    [evaluation] = problem.evaluate(problem.start[None], False)
    if not evaluation.ok:
        return evaluation.status
    what, value = "minimize", evaluation.objective
    if problem.sign < 0.0:
        what, value = "maximize", -value
    factor, name = _shown(unit(problem.stated_objective))
    values = [Value(what, words(problem.stated_objective), factor * value, name, "")]
    own = evaluation.constraints[problem.peaks :]
    for constraint, rows in zip(problem.constraints, problem.constraint_rows, strict=True):
        c, limits, scales = own[rows], problem.limits[rows], problem.reference.scale[rows]
        worst = int(governing_row(constraint, c))
        limit, value = float(limits[worst]), float(limits[worst] + c[worst] * scales[worst])
        violation = abs(c[worst]) if constraint.kind == "equal" else c[worst]
        note = "violated" if violation > FEASIBILITY else ""
        if limit and constraint.limit != "initial":
            note = _implausible(value, limit, constraint.kind) or note
        factor, name = _shown(unit(constraint.measure))
        if len(values) < criteria:
            values.append(Value("minimize", words(constraint.measure), factor * value, name, ""))
            continue
        text = "initial" if constraint.limit == "initial" else f"{factor * limit:.6g}"
        kind = "equal to" if constraint.kind == "equal" else constraint.kind.replace("_", " ")
        values.append(Value(f"{kind} {text}", words(constraint.measure), factor * value, name, note))
    return values


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


def print_start_values(problem: Problem, console: Console, criteria: int = 1) -> None:
    """Print the responses at the start design, or why it cannot be simulated."""
    values = start_values(problem, criteria)
    if isinstance(values, str):
        console.print(f"the start design {values}", markup=False, soft_wrap=True)
        return
    console.print("at the start design:", markup=False)
    rows = [(f"  {one.asked}", one.words, f"{one.value:.6g} {one.unit or ''}".rstrip(), one.note) for one in values]
    asked, _, number, note = (max(map(len, column)) for column in zip(*rows, strict=True))
    width = max(console.width - asked - number - note - 6, 16)
    for row in rows:
        lines = textwrap.wrap(row[1], width)
        wide = min(width, max(len(one.words) for one in values))
        console.print(f"{row[0]:<{asked}}  {lines[0]:<{wide}}  {row[2]:<{number}}  {row[3]}".rstrip(), **_PLAIN)
        for line in lines[1:]:
            console.print(" " * (asked + 2) + line, **_PLAIN)
