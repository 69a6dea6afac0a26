"""What a problem asks of a motion: every history of its objective and its constraints once, with limits and windows.

Pictures over time (criteria.py) and animations (animation.py) have a panel for each. Checked in tests/viz/test_criteria.py.
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

SIGNS = {"at_most": "at most", "at_least": "at least", "equal": "equal to"}


@dataclass
class Panel:
    """A history with what the problem asks of it."""

    history: History
    asked: list[str] = field(default_factory=list)
    limits: list[tuple[float, str]] = field(default_factory=list)  # number [SI], kind
    windows: list[tuple[float, float]] = field(default_factory=list)


def panels_of(problem: Problem) -> list[Panel]:
    """One for every history, in the order of the question."""
    found: list[Panel] = []
    limits = first_limits(problem)
    for asked, limit in [(problem.stated_objective, None), *zip(problem.constraints, limits, strict=True)]:
        outer = asked.measure if isinstance(asked, Constraint) else asked
        for history, measure in histories_of(outer):
            panel = next((known for known in found if known.history == history), None)
            if panel is None:
                found.append(panel := Panel(history))
            panel.asked.append(_asked(asked, limit, "minimize" if problem.sign > 0.0 else "maximize"))
            # A limit of the history itself: not of its integral, nor of what is computed of its measure.
            if isinstance(asked, Constraint) and measure is outer and _of_one_unit(measure, history):
                panel.limits.append((float(limit or 0.0), asked.kind))
            if (window := getattr(measure, "window", None)) is not None:
                panel.windows.append(window)
    return found


def _of_one_unit(measure: Measure, history: History) -> bool:
    kinds = isinstance(measure, (OfHistory, AtTime)) and not isinstance(measure, Integral)
    return kinds and unit(measure) == unit(history)


def _asked(asked: Measure | Constraint, limit: float | None, goal: str) -> str:
    if isinstance(asked, Measure):
        return f"{goal} {words(asked, bodies=False)}"
    factor, name = shown(unit(asked.measure))
    return f"{words(asked.measure, bodies=False)} {SIGNS[asked.kind]} {factor * (limit or 0.0):.4g} {name}".rstrip()


def first_limits(problem: Problem) -> list[float]:
    """The limit of every constraint [SI]: all rows of one have the same."""
    return [float(problem.limits[rows.start]) for rows in problem.constraint_rows]


def histories_of(measure: Measure) -> Iterator[tuple[History, Measure]]:
    """Every history that a measure is made of, and the measure that takes it."""
    values: list[Any] = [getattr(measure, f.name) for f in fields(measure)] if is_dataclass(measure) else []
    while values:
        value = values.pop(0)
        if isinstance(value, History):
            yield value, measure
        elif isinstance(value, Measure):
            yield from histories_of(value)
        elif isinstance(value, (list, tuple)):
            values = [*value, *values]


def shown(si: str | None) -> tuple[float, str]:
    """The factor and the name of the unit in which numbers of an SI unit are drawn."""
    return (180.0 / math.pi, "deg") if si == "rad" else (1.0, si or "")


def full_name(history: History) -> str:
    """A history in words, with the point and the direction that it is of."""
    node, axis = (getattr(history, name, None) for name in ("node", "axis"))
    own = [node, None if isinstance(axis, str) else axis]
    return ", ".join([words(history), *(str(x) for x in own if x is not None)])
