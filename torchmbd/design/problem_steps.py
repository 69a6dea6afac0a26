"""How many steps the motions of a problem have: as given, or as the errors of its responses ask for.

    n <- 1.1 n sqrt(e / tolerance)      e: the largest error of a response by steps, over its size or its margin

e of n steps is estimated by a motion of half of them, whose error is four times as large; where that is resolved, its error
by up to FAR times its own steps is known as well, and needs no motion. The first n is that of the motion
(integrate/step_count.py), by the error of its largest vibrations; a response may ask for more: a residual vibration, a
difference of large numbers. This first motion is compared with one of 2.3 times longer steps. If the errors of the longer steps
are above the tolerance, a motion of shorter steps follows.

The error of a response is divided by its size (`Measure.size`), which a constant part does not change. A constraint has the
larger of its size and its distance from the limit. The objective of a design that a search has found has the larger of its
size there and a tenth of its size at the start.

Impacts, stiff contacts and chaos may keep the error above the tolerance with MOST times the first steps, or with MOST_STEPS.
Then the steps with the least error are taken, and a warning says error and steps.

Errors of motions are kept for the last KEPT problems of a process by the digest of their settings (math/digest.py), so that
two equal problems choose once. Another number anywhere in the system, the motion or the responses is another digest. A problem
whose contents have no digest keeps its errors for itself.
Checked in tests/design/test_problem_steps.py.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch

from torchmbd.design.response import Measure
from torchmbd.diagnosis.response_error import response_error
from torchmbd.errors import InputError, SimulationFailure, warn
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.digest import digest
from torchmbd.progress import stage
from torchmbd.results.motion_data import OK
from torchmbd.results.response_error import rows_of

TOLERANCE = 0.01  # of every response and of every limit
COARSE = 10.0  # times the tolerance, far from an optimum
KEPT = 16  # problems whose errors a process keeps
MOST, MOST_STEPS = 16, 100_000  # times the first steps; steps
_MOST_REFINED = 4  # times the steps of a search, which asks again
_OF_START = 0.1  # of the objective at the start, whose share counts where a search brings the objective to nothing
_MORE = 1.1  # times the steps that the estimate says
_LEAST_MORE, _MOST_MORE = 1.2, 8.0  # times the steps before
_UNKNOWN = 4.0  # times the steps before, of a response that is not resolved
FAR = 4  # times the steps of a motion: so far its error, once resolved, is taken to fall with the square of the step
_FALLS = 0.7  # of the error before: where it is larger twice, further steps do not help


@dataclass(frozen=True)
class StepChoice:
    """Steps for a design.

    steps      a number of steps; None: its motions cannot be simulated, or their method has no estimate
    error      largest error by these steps, over size or margin of its response; nan: unknown
    response   the response with this error
    reason     why it is not resolved, "" where it is
    """

    steps: int | None
    error: float = math.nan
    response: str = ""
    reason: str = ""

    def by(self, steps: int) -> StepChoice:
        """The error by other steps, of a method of second order."""
        return replace(self, steps=steps, error=self.error * (self.steps / steps) ** 2 if self.steps else self.error)

    def meets(self, tolerance: float) -> bool:
        """True if all errors are resolved and at most the tolerance."""
        return self.error <= tolerance and not self.reason

    def __str__(self) -> str:
        if not math.isfinite(self.error):
            return f"with {self.steps} steps the error of {self.response} is not known ({self.reason or 'no number'})"
        why = f" ({self.reason})" if self.reason else ""
        return f"{self.steps} steps have an error of {100.0 * self.error:.2g} % in {self.response}{why}"


def checked_tolerance(tolerance: Any) -> float | None:
    """A tolerance of the errors by steps, or None; InputError for others than numbers above 0 and below 1."""
    if tolerance is None or (is_real(tolerance) and 0.0 < tolerance < 1.0):
        return None if tolerance is None else float(tolerance)
    raise InputError("tolerance", tolerance, "a number above 0 and below 1, or None")


def problem_steps(problem: Any) -> int | None:
    """Steps of every motion of a problem: as given, else as many as the initial design needs (`steps_for`).

    All designs have the same: a criterion that changes its number of steps with the design is not smooth. None: the initial
    design cannot be simulated, and each batch of designs chooses.
    """
    if problem.simulation.steps:
        return problem.simulation.steps
    with stage("choosing the steps for the start design"):
        choice = steps_for(problem, problem.start)
    if not math.isnan(choice.error) and not choice.meets(problem.tolerance):
        _warn(problem, choice)
    return choice.steps


def _warn(problem: Any, choice: StepChoice) -> None:
    warn(f"none of the tried numbers of steps has all errors below tolerance = {problem.tolerance:g}: {choice}")


def steps_for(
    problem: Any,
    x: np.ndarray,
    steps: int | None = None,
    tolerance: float | None = None,
    most: int = MOST,
    least_size: float = 0.0,
) -> StepChoice:
    """The steps by which the errors of all responses of a design [n] are within a tolerance; else those of least error.

    steps       to begin with; None: those that its motions choose
    tolerance   share of every response and limit; None: that of the problem
    most        times the first steps
    least_size  of the objective, by which its error is measured
    """
    tolerance = tolerance or problem.tolerance
    enough = tolerance or 0.0
    errors = _errors_of(problem, x, steps, least_size, enough) if steps else _first_errors(problem, x)
    n = steps or errors.first
    if n is None or errors.multiple is None or tolerance is None:
        return StepChoice(n)
    limit, tried = min(most * n, max(MOST_STEPS, n)), []
    while True:
        tried.append(errors.choice.by(n))
        if not (tried[-1].meets(tolerance) or n >= limit or _is_stuck(tried)):
            growth = _MORE * math.sqrt(tried[-1].error / tolerance) if math.isfinite(tried[-1].error) else _MOST_MORE
            growth = min(max(growth, _UNKNOWN if tried[-1].reason else _LEAST_MORE), _MOST_MORE)
            n = min(limit, math.ceil(growth * n))
            n = -(-n // errors.multiple) * errors.multiple
            if errors.choice.reason or n > FAR * (errors.choice.steps or n):
                errors = _errors_of(problem, x, n, least_size, enough)
                if errors.multiple is not None:
                    continue
            tried.append(errors.choice.by(n))
        return min(tried, key=lambda choice: (not choice.meets(tolerance), choice.error))


def accuracy(problem: Any) -> str:
    """The number of steps of the motions, if the problem chooses it; "" if it was given."""
    return f"{problem.steps} steps" if problem.chooses_steps and problem.steps else ""


def coarse_problem(problem: Any) -> Any:
    """The problem with fewer steps (COARSE times its tolerance) for the first half of a search; None: it has no fewer."""
    if not problem.chooses_steps or problem.steps is None or problem.tolerance is None:
        return None
    choice = steps_for(problem, problem.start, tolerance=COARSE * problem.tolerance)
    return None if choice.steps is None or choice.steps >= problem.steps else with_steps(problem, choice.steps)


def refined_problem(problem: Any, x: np.ndarray) -> Any:
    """The problem with the steps that a design [n] needs; None if it has them, or if steps were given."""
    if not problem.chooses_steps or problem.steps is None:
        return None
    size = _OF_START * _first_errors(problem, problem.start).objective
    choice = steps_for(problem, x, problem.steps, most=_MOST_REFINED, least_size=size)
    if choice.steps is None or choice.steps <= problem.steps:
        return None
    if not choice.meets(problem.tolerance):
        _warn(problem, choice)
        return None
    return with_steps(problem, choice.steps)


def with_steps(problem: Any, steps: int) -> Any:
    """The same problem with other steps: limits and scales "initial" are computed with these steps."""
    other = copy.copy(problem)
    for name in ("reference", "steps", "coarse"):
        other.__dict__.pop(name, None)
    other.simulation = problem.simulation.with_steps(steps)
    _known[other] = _known_of(problem)  # the errors of motions by given numbers of steps
    return other


def _is_stuck(tried: list[StepChoice]) -> bool:
    errors = [choice.error for choice in tried]
    return len(errors) > 2 and errors[-1] > _FALLS * errors[-2] > _FALLS**2 * errors[-3]


class _Errors(NamedTuple):
    """What is known of the motions of a design by so many steps.

    choice     their steps, and the largest error of all responses in all lanes
    multiple   number that divides the steps of every motion; None: the motions fail, or their method has no estimate
    objective  the size of the objective, the largest of all lanes; 0: not known
    first      steps that the motions choose themselves; None: steps were given, or the motions fail
    """

    choice: StepChoice
    multiple: int | None
    objective: float = 0.0
    first: int | None = None


def _errors_of(problem: Any, x: np.ndarray, steps: int, least_size: float, enough: float) -> _Errors:
    """Errors by so many steps: from motions of half of them, or by themselves where half are too few for a motion.

    enough   share of a response: where half of the steps have no larger error, it is small enough however it falls
    """
    errors = _errors(problem, x, (steps + 1) // 2, least_size, enough)
    return errors if errors.multiple is not None else _errors(problem, x, steps, least_size)


def _first_errors(problem: Any, x: np.ndarray) -> _Errors:
    """Errors of a design [n] by motions of longer steps than its motions choose; once for each design.

    Where these are not within the tolerance, the errors of the motions themselves are estimated.
    """
    known, key = _known_of(problem), (np.asarray(x, dtype=float).tobytes(), None)
    if key not in known:
        motions = _motions(problem, x, None)
        first = motions[0].require_repetition().steps if motions else None
        again = [motion.require_repetition() for motion in motions]
        longer = [r.by_longer_steps(m) for r, m in zip(again, motions, strict=True) if r.has_equal_steps]
        sound = [motion for motion in longer if motion is not None and all(status == OK for status in motion.status)]
        steps = {motion.require_repetition().steps for motion in sound}
        errors = None
        if motions and len(sound) == len(motions) and len(steps) == 1:
            errors = _estimated(problem, sound, None, 0.0, problem.tolerance or 0.0)
        if errors is None or not errors.choice.meets(problem.tolerance or 0.0):
            errors = _estimated(problem, motions, None, 0.0, 0.0)
        known[key] = errors._replace(first=first)
    return known[key]


def _errors(problem: Any, x: np.ndarray, steps: int, least_size: float, enough: float = 0.0) -> _Errors:
    """Simulate a design [n] by equal steps, and estimate the errors; once for each design and number of steps."""
    known, key = _known_of(problem), (np.asarray(x, dtype=float).tobytes(), steps, least_size, enough)
    if key not in known:
        known[key] = _estimated(problem, _motions(problem, x, steps), steps, least_size, enough)
    return known[key]


_known: WeakKeyDictionary[Any, dict[tuple, _Errors]] = WeakKeyDictionary()  # of each problem
_of_equal_problems: OrderedDict[str, dict[tuple, _Errors]] = OrderedDict()  # by the digest of their settings


def _known_of(problem: Any) -> dict[tuple, _Errors]:
    """Errors by designs and steps that are known of a problem, or of an equal one before it."""
    if problem not in _known:
        key = _digest_of(problem)
        _known[problem] = {} if key is None else _of_equal_problems.pop(key, {})
        if key is not None:
            _of_equal_problems[key] = _known[problem]
        while len(_of_equal_problems) > KEPT:
            _of_equal_problems.popitem(last=False)
    return _known[problem]


def _digest_of(problem: Any) -> str | None:
    """The digest of all that motions and responses depend on; None: contents of the problem cannot be compared."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return digest(type(problem), *problem.settings())
        except (Warning, TypeError, AttributeError, ValueError, RuntimeError):  # by the kind of object
            return None


def _motions(problem: Any, x: np.ndarray, steps: int | None) -> list[Trajectory]:
    """Motions of a design [n] without gradients, one for each system, by equal steps; none where one fails."""
    motions = []
    for simulation, designs in problem.cases(np.asarray(x)[None]):
        try:
            motion = simulation.with_steps(steps)(designs, gradients="none")
        except (InputError, SimulationFailure):
            return []
        if any(status != OK for status in motion.status):
            return []
        motions.append(motion)
    most = max((motion.require_repetition().steps for motion in motions), default=steps)
    return (
        motions if all(motion.require_repetition().steps == most for motion in motions) else _motions(problem, x, most)
    )


def _estimated(problem: Any, motions: list[Trajectory], steps: int | None, least_size: float, enough: float) -> _Errors:
    """The largest error of all responses in all lanes of motions; not known: they fail."""
    if not motions:
        return _Errors(StepChoice(steps, math.inf, "every response", "the motion fails"), None)
    steps = motions[0].require_repetition().steps
    if not all(motion.require_repetition().has_equal_steps for motion in motions):
        return _Errors(StepChoice(steps), None)
    measures = [(problem.objective, None), *((c.measure, c.limit) for c in problem.constraints)]
    worst = StepChoice(steps, 0.0, "all responses")
    for motion in motions:
        for measure, limit in measures:
            least = partial(torch.full_like, fill_value=least_size) if limit is None else partial(_margin, limit)
            share, reason = _share(motion, measure.at_start(motions[0]), least, enough)
            if (bool(reason), share) > (bool(worst.reason), worst.error):
                worst = StepChoice(steps, share, repr(measure), reason)
    each = [motion.require_repetition().multiple for motion in motions]
    objective = problem.objective.at_start(motions[0])
    size = max(float(objective.size(motion).max()) for motion in motions)
    return _Errors(worst, math.lcm(*each), size if math.isfinite(size) else 0.0)


def _margin(limit: float | str, value: torch.Tensor) -> torch.Tensor:
    """The distance of values from a limit; zeros for a limit "initial", which the start meets."""
    return torch.zeros_like(value) if limit == "initial" else (value - float(limit)).abs()


def _share(motion: Trajectory, measure: Measure, least: Any, enough: float) -> tuple[float, str]:
    """The largest error by steps over size or `least`, inf where it is not known; and why it is not resolved."""
    try:
        error = response_error(motion, measure, modes=False, mesh=False, enough=enough, least=least)
    except InputError as refusal:
        return math.inf, str(refusal)
    by_steps = rows_of(error.by_steps.abs())
    shares = torch.where(by_steps == 0.0, 0.0, by_steps / rows_of(error.size)).nan_to_num(nan=math.inf)
    return float(shares.max()), next((reason for reason in error.reasons if reason), "")
