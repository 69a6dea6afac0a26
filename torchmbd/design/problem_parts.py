"""Parts of a problem: the objective with its sign, the constraints, the numbers of the initial design, evaluations.

Checked in tests/design/test_problem.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from torchmbd.design.measures import Frequency, Mass
from torchmbd.design.response import Constraint, Measure
from torchmbd.design.words import words
from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import list_of
from torchmbd.multibody.bodies.flexible import FlexibleBody
from torchmbd.optimization import Evaluation
from torchmbd.optimization.extra_variable import ExtraVariable
from torchmbd.results.motion_data import OK


class Reference(NamedTuple):
    """Measures, limits and scales of a problem, with numbers for all that refers to the initial design.

    measures  objective, then one for each constraint
    extra     the extra variable of a min-max problem
    limits    c of every row of the constraints [m]
    scale     divisor of g - c of each row: positive, or negative for lower limits [m]
    """

    measures: list[Measure]
    extra: ExtraVariable
    limits: np.ndarray
    scale: np.ndarray


def constraints_of(subject_to: Any) -> list[Constraint]:
    """A constraint, or a list of them, as a list; InputError names an entry that is not a constraint."""
    constraints = [subject_to] if isinstance(subject_to, Constraint) else subject_to
    return list_of("subject_to", constraints, Constraint, "constraints, such as Max(...) <= 'initial'")


def stated_objective(minimize: Any, maximize: Any) -> tuple[Measure, float]:
    """The measure that is minimized or maximized, and its sign in the minimization: 1, or -1 for `maximize`."""
    if minimize is not None and maximize is not None:
        raise InputError(
            "minimize", minimize, "must not be given together", shown=f"{minimize!r} and maximize = {maximize!r}"
        )
    if minimize is None and maximize is None:
        state, allowed = "is missing", "a measure, here or as 'maximize'"
        raise InputError("minimize", noun="'minimize' of Problem", allowed=allowed, state=state)
    name, measure = ("minimize", minimize) if maximize is None else ("maximize", maximize)
    if not isinstance(measure, Measure):
        raise InputError(name, measure, "a measure, such as Integral(StrainEnergy('rod'))")
    if maximize is not None and measure.rows > 1:
        shown = f"{measure!r}, of {measure.rows} rows"
        raise InputError("maximize", measure, "a measure of one number", shown=shown)
    return measure, 1.0 if maximize is None else -1.0


def require_duration(measure: Measure, duration: float) -> None:
    """InputError for a measure that looks at times beyond the simulated one [s]."""
    if measure.until > duration * (1.0 + 1e-9):  # of rounding
        state, allowed = f"looks at t = {measure.until:g} s", f"must look at most at duration={duration:g} s"
        argument = next((name for name in ("time", "times") if hasattr(measure, name)), "window")
        raise InputError(argument, measure.until, allowed, noun=repr(measure), state=state)


def limits_of(constraint: Constraint, initial: np.ndarray) -> np.ndarray:
    """The limit of every row of a constraint [..., rows], of their values at the initial design [..., rows].

    A limit "initial" is the largest row of <=, the least of >=; every row of an equality keeps its value.
    """
    if constraint.limit != "initial":
        return np.full(initial.shape, float(constraint.limit))
    if constraint.kind == "equal":
        return initial
    extreme = initial.min if constraint.kind == "at_least" else initial.max
    return np.broadcast_to(extreme(axis=-1, keepdims=True), initial.shape)


def reference_of(
    constraints: Sequence[Constraint], measures: list[Measure], extra: ExtraVariable, limits: Sequence[np.ndarray]
) -> Reference:
    """The reference of a problem, of the limits of every row of its constraints."""
    scales = [_scales(constraint, rows) for constraint, rows in zip(constraints, limits, strict=True)]
    none = np.zeros(0)
    return Reference(measures, extra, np.concatenate([none, *limits]), np.concatenate([none, *scales]))


def _scales(constraint: Constraint, limits: np.ndarray) -> np.ndarray:
    """The divisor of g - limit of every row [rows]: positive, or negative for a lower limit."""
    size = np.abs(limits) if constraint.scale is None else np.full(limits.shape, float(constraint.scale))
    size = np.where(size > 0.0, size, 1.0)
    return -size if constraint.kind == "at_least" else size


def governing_row(constraint: Constraint, scaled: np.ndarray) -> Any:
    """The row of a constraint that is nearest to its limit or farthest beyond, of rows [..., rows] as optimizers see them.

    The row of the largest value of <=, of the least of >=, and of the largest deviation of an equality.
    """
    return np.argmax(np.abs(scaled) if constraint.kind == "equal" else scaled, axis=-1)


def responses_of(
    constraints: Sequence[Constraint], rows: Sequence[slice], reference: Reference, scaled: np.ndarray
) -> list[np.ndarray]:
    """The constrained responses of designs [lanes], of each constraint its governing row, in the unit of the measure.

    rows    of each constraint
    scaled  rows of all constraints as optimizers see them, without those of a min-max objective [lanes, m]
    """
    responses = []
    for constraint, part in zip(constraints, rows, strict=True):
        values = scaled[:, part] * reference.scale[part] + reference.limits[part]
        chosen = governing_row(constraint, scaled[:, part])
        responses.append(np.take_along_axis(values, chosen[:, None], 1)[:, 0])
    return responses


def evaluation_of(
    status: str, values: np.ndarray, gradients: np.ndarray | None, measures: Sequence[Measure]
) -> Evaluation:
    """The evaluation of a design from its status, objective and constraints [1 + m], and their gradients [1 + m, n].

    measures  of each of these rows
    """
    if status == OK and not (finite := np.isfinite(values)).all():
        measure, x = measures[int(np.argmin(finite))], values[np.argmin(finite)]
        status = f"failed: {words(measure)} is {'not a number' if math.isnan(x) else 'infinite'}"
        status += f": {measure.infinite_note}" * bool(measure.infinite_note and math.isinf(x))
    elif status == OK and gradients is not None and not (finite := np.isfinite(gradients).all(1)).all():
        status = f"failed: the gradient of {words(measures[int(np.argmin(finite))])} is not finite"
    if status != OK:
        return Evaluation.failure(status, len(values) - 1)
    if gradients is None:
        return Evaluation(float(values[0]), values[1:])
    return Evaluation(float(values[0]), values[1:], gradients[0], gradients[1:])


def masses_and_frequencies(problem: Any, count: int) -> list[Measure]:
    """Mass and first `count` frequencies of the bodies that are designed, where the problem does not ask for them already.

    A shell that is held at one node has no such row: its frequencies fall with every finer mesh (`is_held_at_a_point`).
    """
    bodies = dict.fromkeys(name.partition(".")[0] for name in problem.space.variables)
    wanted = [Mass(body) for body in bodies]
    held = [body for body in bodies if not _is_held_at_a_point(problem.system, body)]
    wanted += [Frequency(body, k + 1) for body in held for k in range(count)]
    known = [problem.stated_objective, *(constraint.measure for constraint in problem.constraints)]
    measures = []
    for measure in wanted:
        try:
            measure.check(problem.system)
        except InputError:  # a rigid body has no frequency, a controller no mass
            continue
        measures += [measure] * (measure not in known)
    return measures


def _is_held_at_a_point(system: Any, name: str) -> bool:
    """True if the body of this name is a shell that one node holds."""
    body = next((body for body in system.bodies if body.name == name), None)
    return isinstance(body, FlexibleBody) and body.is_held_at_a_point
