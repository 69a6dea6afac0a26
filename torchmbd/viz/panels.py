"""The histories of the objective and the constraints of a problem, each once, with limits and windows.

Figures over time (criteria.py) and animations (animation.py) have a panel for each. Checked in tests/viz/test_criteria.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from torchmbd.design.measures import AtTime, Integral, OfHistory
from torchmbd.design.problem import Problem
from torchmbd.design.response import Constraint, History, Measure
from torchmbd.design.words import unit, words
from torchmbd.errors import InputError

SIGNS = {"at_most": "at most", "at_least": "at least", "equal": "equal to"}


@dataclass
class Panel:
    """A history with the responses, limits and windows that use it."""

    history: History
    goals: list[str] = field(default_factory=list)  # such as "minimize integral of ..."
    limits: list[tuple[float, str]] = field(default_factory=list)  # number [SI], kind
    windows: list[tuple[float, float]] = field(default_factory=list)


def panels_of(problem: Problem) -> list[Panel]:
    """Return a panel for each history, objective first."""
    panels: list[Panel] = []
    limits = first_limits(problem)
    for response, limit in [(problem.stated_objective, None), *zip(problem.constraints, limits, strict=True)]:
        outer = response.measure if isinstance(response, Constraint) else response
        for history, measure in histories_of(outer):
            panel = next((known for known in panels if known.history == history), None)
            if panel is None:
                panels.append(panel := Panel(history))
            panel.goals.append(_question_words(response, limit, "minimize" if problem.sign > 0.0 else "maximize"))
            # Only limits of the history itself are drawn, not those of its integral or of other functions of it.
            itself = isinstance(measure, (OfHistory, AtTime)) and not isinstance(measure, Integral)
            if isinstance(response, Constraint) and measure is outer and itself and unit(measure) == unit(history):
                panel.limits.append((float(limit or 0.0), response.kind))
            if (window := getattr(measure, "window", None)) is not None:
                panel.windows.append(window)
    return panels


def _question_words(response: Measure | Constraint, limit: float | None, goal: str) -> str:
    if isinstance(response, Measure):
        return f"{goal} {words(response, bodies=False)}"
    factor, name = display_unit(unit(response.measure))
    return (
        f"{words(response.measure, bodies=False)} {SIGNS[response.kind]} {factor * (limit or 0.0):.4g} {name}".rstrip()
    )


def require_problem(problem: Any) -> None:
    """InputError unless the argument is a Problem."""
    if not isinstance(problem, Problem):
        raise InputError("problem", problem, "mbd.Problem(...)")


def first_limits(problem: Problem) -> list[float]:
    """Return the limit of each constraint [SI]; its rows have the same limit."""
    return [float(problem.limits[rows.start]) for rows in problem.constraint_rows]


def histories_of(measure: Measure) -> Iterator[tuple[History, Measure]]:
    """Yield every history of which a measure is computed, with the innermost measure that uses it."""
    values: list[Any] = [getattr(measure, f.name) for f in fields(measure)] if is_dataclass(measure) else []
    while values:
        value = values.pop(0)
        if isinstance(value, History):
            yield value, measure
        elif isinstance(value, Measure):
            yield from histories_of(value)
        elif isinstance(value, (list, tuple)):
            values = [*value, *values]


def display_unit(si: str | None) -> tuple[float, str]:
    """Return factor and name of the unit in which numbers of an SI unit are drawn: degrees for angles."""
    return (180.0 / math.pi, "deg") if si == "rad" else (1.0, si or "")


def full_name(history: History) -> str:
    """Return a history in words, with its point and direction."""
    node, axis = (getattr(history, name, None) for name in ("node", "axis"))
    place = [node, None if isinstance(axis, str) else axis]
    return ", ".join([words(history), *(str(x) for x in place if x is not None)])
