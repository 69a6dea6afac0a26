"""How many simulations a search takes: a range, as no method knows before how short its steps will be.

    simulations = rate * iterations + 2 + curvature + parts        of one start that does not end early

rate        of an iteration with its line search: the least and the most of measured searches (RATES)
2           the start, and its neighbor where the start does not tell the size of the objective
curvature   one simulation for each direction at a Kuhn-Tucker point (curvature.py)
parts       of a problem that refines its motions (finer_motions.py): each evaluates its first design, and the last the start

A differential evolution evaluates its whole population in each iteration.
Checked in tests/study/test_counts.py.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Any

from torchmbd.optimization.curvature import MOST_DIRECTIONS
from torchmbd.optimization.finer_motions import refines
from torchmbd.optimization.methods.evolution import evolution

# Simulations of an iteration in searches of a four-bar linkage from one to three starts: the fewest of integrals, the most of
# peaks, whose kinks make line searches long.
RATES = {
    "auto": (1.5, 4.0),
    "sqcqp": (1.5, 4.0),
    "slsqp": (2.0, 9.0),
    "mmfd": (1.5, 6.0),
    "mma": (2.0, 35.0),
    "ccsaq": (2.0, 35.0),
}
_OTHERS = (1.2, 12.0)  # not measured: a guess among those above
_BEGINNING = 2
_PARTS = 4  # at most: two of a coarse part and one finer, and the start by the last


def simulations(problem: Any, method: str, max_iterations: int, options: Mapping[str, Any]) -> tuple[int, int]:
    """Return the fewest and the most evaluations of a search from one start that does not end early.

    options   of the search and of the method: `max_analyses` is a limit of both numbers, `population` as in `evolution`
    """
    size, most = len(problem.names), options.get("max_analyses")
    if method == "differential_evolution":
        default = inspect.signature(evolution).parameters["population"].default
        drawn = size - bool(getattr(problem, "has_extra_variable", False))
        low, high = 2 * ((max_iterations + 1) * options.get("population", default) * drawn,)
    else:
        low, high = (rate * max_iterations for rate in RATES.get(method, _OTHERS))
    high += _BEGINNING + min(size, MOST_DIRECTIONS) + _PARTS * refines(problem)
    low, high = math.ceil(low), math.ceil(high)
    return (low, high) if most is None else (min(low, most), min(high, most))
