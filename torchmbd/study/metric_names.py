"""Names of the metrics of a study. MLflow's charts stand in groups by what is before the `/`; those without come first.

    objective, violation, reduction_percent, best_objective    what was asked for; increase_percent where it is to be large
    constraint/max of strain energy of rod                     satisfied where it is not positive
    design/angle_1_deg                                         the design, in the units of the study
    criterion/mass_kg                                          of a point of a front
    search/iterations, search/analyses, ...                    what it took

Checked in tests/study/test_metric_names.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from torchmbd.math.units import UNITS

CONSTRAINT, CRITERION, DESIGN, SEARCH = "constraint/", "criterion/", "design/", "search/"
REDUCTION, INCREASE = "reduction_percent", "increase_percent"
ITERATIONS, ANALYSES = f"{SEARCH}iterations", f"{SEARCH}analyses"
EVALUATIONS, FAILED = f"{SEARCH}evaluations", f"{SEARCH}failed_evaluations"
STARTS, CONVERGED = f"{SEARCH}starts", f"{SEARCH}converged_starts"


def gain(sign: float) -> str:
    """The metric of how much better the objective has become."""
    return REDUCTION if sign > 0.0 else INCREASE


def is_design(metric: str) -> bool:
    """Whether a metric is a design variable."""
    return metric.startswith(DESIGN)


def asked(metrics: Iterable[Mapping[str, float]], sign: float = 1.0) -> list[str]:
    """The metrics of what is asked for: the objective and how much better it has become, or the criteria of a front."""
    criteria = dict.fromkeys(name for found in metrics for name in found if name.startswith(CRITERION))
    return list(criteria) or ["objective", gain(sign)]


def short(metric: str) -> str:
    """A metric without its group."""
    return metric.partition("/")[2] or metric  # a unit such as N/mm has a stroke too


def heading(metric: str) -> str:
    """The title of a metric's column: `angle 1 [deg]`, `reduction [%]`."""
    word, _, last = short(metric).replace("percent", "%").rpartition("_")
    return f"{word.replace('_', ' ')} [{last}]" if last in (*UNITS, "%") else short(metric).replace("_", " ")


def constraint_names(problem: Any, count: int) -> list[str]:
    """A name for each of the rows of the constraints; by their numbers where the problem does not tell what they are."""
    from torchmbd.design import Problem  # with torch, which commands that read names spare
    from torchmbd.design.scenarios import Scenarios
    from torchmbd.design.words import words

    said: list[str] = []
    if isinstance(problem, Problem):
        cases = [f" in {name}" for name in problem.scenarios] if isinstance(problem, Scenarios) else []
        text = legal(words(problem.objective))
        said = [f"peak {k + 1}" for k in range(problem.peaks)]
        if cases and problem.peaks == len(cases):
            said = [f"{text}{case}" for case in cases]
        for constraint, rows in zip(problem.constraints, problem.constraint_rows, strict=True):
            text, each = legal(words(constraint.measure)), constraint.measure.rows
            there = cases if cases and rows.stop - rows.start == each * len(cases) else [""]
            said += [text + legal(case) + (f" {k + 1}" if each > 1 else "") for case in there for k in range(each)]
    if len(said) != count:  # over tolerances: those of many designs
        said = [str(k + 1) for k in range(count)]
    return [CONSTRAINT + name for name in _unique(said)]


def _unique(names: Sequence[str]) -> list[str]:
    """The same names, with a number behind those that occur before."""
    return [
        name if k == names.index(name) else f"{name} no {names[:k].count(name) + 1}" for k, name in enumerate(names)
    ]


def legal(key: str) -> str:
    """MLflow allows letters, digits and _-.:/ and spaces in a key."""
    return "".join(c if c.isalnum() or c in "_-.:/ " else "_" for c in key)
