"""Errors of the objective and of every constraint of a problem, by the steps, modes and meshes of its motions.

Checked in tests/design/test_response_errors.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.results.response_error import ResponseError


def problem_errors(problem: Any, x: np.ndarray, *, modes: bool = True, mesh: bool = True) -> list[ResponseError]:
    """Errors of the objective, then of every constraint, at a design [n], by further simulations of it (`error_of`).

    modes, mesh   whether the errors by modes and by meshes are estimated
    Each error is that of the measure, in its unit and with the sign that `minimize` or `maximize` states.
    Raises InputError for scenarios, whose objective is of several motions; SimulationFailure for a design without a motion.
    """
    if problem.simulations != 1 or hasattr(problem, "scenarios"):
        raise InputError("errors of scenarios; allowed: error_of of the motions of each, problem.motions(x)")
    objective, *others = problem.reference.measures
    stated = objective if problem.sign > 0.0 else -objective
    motion = problem.motion(x)
    errors = [motion.error_of(measure, modes=modes, mesh=mesh) for measure in (stated, *others)]
    names = [repr(problem.stated_objective), *(repr(c) for c in problem.constraints)]
    return [replace(error, name=name) for error, name in zip(errors, names, strict=True)]
