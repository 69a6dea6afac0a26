"""Errors of the objective and of every constraint of a problem, by the steps, modes and meshes of its motions.

Checked in tests/diagnosis/test_response_errors.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from torchmbd.design.response import Measure
from torchmbd.design.scenario_settings import combined
from torchmbd.results.response_error import ResponseError


def problem_errors(problem: Any, x: np.ndarray, *, modes: bool = True, mesh: bool = True) -> list[ResponseError]:
    """Errors of the objective, then of every constraint, at a design [n], by further simulations of it (`error_of`).

    modes, mesh   whether the errors by modes and by meshes are estimated
    Each error is that of the measure, in its unit and with the sign that `minimize` or `maximize` states. Over scenarios: of
    the rows that the optimizer sees, such as those of all scenarios.
    Raises SimulationFailure for a design without a motion.
    """
    X = problem.checked_designs(np.asarray(x)[None], len(problem.space.names), len(problem.names))
    return design_errors(problem, X, modes=modes, mesh=mesh)


def design_errors(
    problem: Any, X: np.ndarray, others: Sequence[Measure] = (), modes: bool = True, mesh: bool = True
) -> list[ResponseError]:
    """The errors of several designs [lanes, n] as one batch, a lane for each; then those of `others`, in the first scenario."""
    objective, *measures = problem.reference.measures
    stated = objective if problem.sign > 0.0 else -objective
    names = [repr(problem.stated_objective), *(repr(c) for c in problem.constraints), *map(repr, others)]
    motions = problem._motions(X, False)
    every = (stated, *measures, *others)
    errors = [[motion.error_of(measure, modes=modes, mesh=mesh) for motion in motions] for measure in every]
    if not hasattr(problem, "scenarios"):
        return [replace(error, name=name) for [error], name in zip(errors, names, strict=True)]
    rules = [*problem.rules, *[("first", False)] * len(others)]
    return [
        replace(_over_scenarios(problem, parts, len(X), *rule), name=name)
        for parts, rule, name in zip(errors, rules, names, strict=True)
    ]


def _over_scenarios(
    problem: Any, errors: Sequence[ResponseError], lanes: int, rule: str, lower_limit: bool
) -> ResponseError:
    """The error of a measure over all scenarios, from those of each system [lanes * scenarios of it]."""

    def rows(parts: Sequence[torch.Tensor]) -> np.ndarray:
        values = problem.in_scenario_order([x.reshape(lanes, len(x) // lanes, -1).numpy() for x in parts])
        return values[:, 0] if rule == "first" else combined(rule, values, None, problem.weights, lower_limit)[0]

    value = rows([error.value for error in errors])

    def change(parts: Sequence[torch.Tensor | None]) -> torch.Tensor | None:
        """The change of the joined rows by one kind of error of every system; None where it is not estimated."""
        known = [x for x in parts if x is not None]
        if len(known) < len(errors):
            return None
        return torch.tensor(rows([e.value + x for e, x in zip(errors, known, strict=True)]) - value)

    by_steps = change([error.by_steps for error in errors])
    assert by_steps is not None
    texts = problem.in_scenario_order([np.array(e.reasons, dtype=object).reshape(lanes, -1) for e in errors])
    cases = list(problem.scenarios)
    reasons = tuple(
        next((f"scenario {name!r}: {text}" for name, text in zip(cases, row, strict=True) if text), "") for row in texts
    )
    return ResponseError(
        "",
        torch.tensor(value),
        torch.tensor(rows([error.size for error in errors])),
        torch.tensor(rows([error.change for error in errors])),
        by_steps,
        torch.tensor([not reason for reason in reasons]),
        reasons,
        errors[0].note,
        change([error.by_modes for error in errors]),
        change([error.by_mesh for error in errors]),
        tuple(dict.fromkeys(text for error in errors for text in error.unknown)),
    )
