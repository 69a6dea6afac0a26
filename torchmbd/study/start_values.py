"""What the question's responses are at the start design, beside their limits: wrong units and idle constraints show there.

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

import numpy as np
from rich.console import Console

from torchmbd.design import Problem
from torchmbd.design.words import unit, words
from torchmbd.optimization.api import FEASIBILITY

_FAR = 1e3  # times its limit, or its part: such a value has hardly the unit of the limit
_PLAIN: Any = {"markup": False, "highlight": False, "soft_wrap": True}
_IDLE = 1e-9  # share of the limit: such a value is zero


class Value(NamedTuple):
    """What is asked of a response, its words, its value, its unit (None: not known), and what is to be said of it."""

    asked: str
    words: str
    value: float
    unit: str | None
    note: str


def start_values(problem: Problem, criteria: int = 1) -> list[Value] | str:
    """Return the responses at the start design, of constraints the row nearest to its limit; or why it fails.

    Of a front the first constraints are criteria too: all of these but one.
    """
    [found] = problem.evaluate(problem.start[None], False)
    if not found.ok:
        return found.status
    what, value = ("minimize", found.objective) if problem.sign > 0.0 else ("maximize", -found.objective)
    factor, name = _shown(unit(problem.stated_objective))
    values = [Value(what, words(problem.stated_objective), factor * value, name, "")]
    own = found.constraints[problem.peaks :]
    for constraint, rows in zip(problem.constraints, problem.constraint_rows, strict=True):
        c, limits, scales = own[rows], problem.limits[rows], problem.reference.scale[rows]
        worst = int(np.argmax(np.abs(c) if constraint.kind == "equal" else c))
        limit, value = float(limits[worst]), float(limits[worst] + c[worst] * scales[worst])
        violation = abs(c[worst]) if constraint.kind == "equal" else c[worst]
        note = "violated" if violation > FEASIBILITY else ""
        if limit and constraint.limit != "initial":
            note = _doubt(value, limit, constraint.kind) or note
        factor, name = _shown(unit(constraint.measure))
        if len(values) < criteria:
            values.append(Value("minimize", words(constraint.measure), factor * value, name, ""))
            continue
        text = "initial" if constraint.limit == "initial" else f"{factor * limit:.6g}"
        kind = "equal to" if constraint.kind == "equal" else constraint.kind.replace("_", " ")
        values.append(Value(f"{kind} {text}", words(constraint.measure), factor * value, name, note))
    return values


def _shown(si: str | None) -> tuple[float, str | None]:
    """The factor and the unit in which a response is shown: angles in degrees."""
    return (math.degrees(1.0), "deg") if si == "rad" else (1.0, si)


def _doubt(value: float, limit: float, kind: str) -> str:
    """What is strange about a value beside its limit."""
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
    room = max(console.width - asked - number - note - 6, 16)
    for row in rows:
        lines = textwrap.wrap(row[1], room)
        wide = min(room, max(len(one.words) for one in values))
        console.print(f"{row[0]:<{asked}}  {lines[0]:<{wide}}  {row[2]:<{number}}  {row[3]}".rstrip(), **_PLAIN)
        for line in lines[1:]:
            console.print(" " * (asked + 2) + line, **_PLAIN)
