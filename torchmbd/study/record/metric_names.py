"""Names of the metrics of a study. MLflow groups its charts by the part before `/`; metrics without one come first.

    objective, violation, reduction_percent, best_objective    of minimized objectives; increase_percent of maximized ones
    constraint/max of strain energy of rod                     satisfied where it is not positive
    design/angle_1_deg                                         the design, in the units of the study
    criterion/mass_kg                                          of a point of a front
    search/iterations, search/analyses, ...                    cost of the search
    start/mass of rod_kg, best/..., error/..., margin/...      responses of start and best design, error of the best

Checked in tests/study/record/test_metric_names.py.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from torchmbd.math.units import UNITS

CONSTRAINT, CRITERION, DESIGN, SEARCH = "constraint/", "criterion/", "design/", "search/"
REDUCTION, INCREASE = "reduction_percent", "increase_percent"
ITERATIONS, ANALYSES = f"{SEARCH}iterations", f"{SEARCH}analyses"
EVALUATIONS, FAILED = f"{SEARCH}evaluations", f"{SEARCH}failed_evaluations"
START, BEST, ERROR, MARGIN = "start/", "best/", "error/", "margin/"
_LONGEST, _BEGIN, _END = 220, 120, 60  # characters of a key; MLflow allows 250, its group and a number included
STARTS, CONVERGED = f"{SEARCH}starts", f"{SEARCH}converged_starts"


def gain_metric(sign: float) -> str:
    """Return the name of the metric of the improvement; `sign` is -1 for an objective that is maximized, else 1."""
    return REDUCTION if sign > 0.0 else INCREASE


def is_design(metric: str) -> bool:
    """True if a metric is a design variable."""
    return metric.startswith(DESIGN)


def criterion_metrics(metrics: Iterable[Mapping[str, float]], sign: float = 1.0) -> list[str]:
    """Return the names of the criteria of a front, or of the objective and its improvement."""
    criteria = dict.fromkeys(name for numbers in metrics for name in numbers if name.startswith(CRITERION))
    return list(criteria) or ["objective", gain_metric(sign)]


def without_group(metric: str) -> str:
    """Return the name of a metric without its group."""
    return metric.partition("/")[2] or metric  # a unit such as N/mm contains a slash too


def metric_heading(metric: str) -> str:
    """Return the title of a column of a metric: `angle 1 [deg]`, `reduction [%]`."""
    word, _, last = without_group(metric).replace("percent", "%").rpartition("_")
    return f"{word.replace('_', ' ')} [{last}]" if last in (*UNITS, "%") else without_group(metric).replace("_", " ")


def number_text(metric: str, value: float) -> str:
    """Return the text of a metric: angles and percentages to a hundredth, others to six digits."""
    return f"{value:z.2f}" if metric.endswith(("_deg", "_percent")) else f"{value:.6g}"


def cell_text(cell: str) -> str:
    """Return a number of a stored table to five digits; other text as it is."""
    try:
        return f"{float(cell):.5g}"
    except ValueError:
        return cell


def constraint_names(problem: Any, count: int) -> list[str]:
    """Return the names of the metrics of the constraint rows; numbers where the problem has no names for them."""
    names = [legal_key(name) for name in getattr(problem, "row_names", ())]
    if len(names) != count:  # over tolerances: the rows of many designs
        names = [str(k + 1) for k in range(count)]
    return [CONSTRAINT + name for name in unique(names)]


def unique(names: Sequence[str]) -> list[str]:
    """Return the names, with a number behind each that has occurred before."""
    return [
        name if k == names.index(name) else f"{name} no {names[:k].count(name) + 1}" for k, name in enumerate(names)
    ]


def legal_key(key: str) -> str:
    """Return a key that MLflow allows: of letters, digits, spaces and _-.:/, others replaced, and not too long.

    A number of the whole key stands for the middle of a long one: its end may be a unit.
    """
    allowed = "".join(c if c.isalnum() or c in "_-.:/ " else "_" for c in key)
    if len(allowed) <= _LONGEST:
        return allowed
    return f"{allowed[:_BEGIN]}... {zlib.crc32(key.encode()):08x} ...{allowed[-_END:]}"
