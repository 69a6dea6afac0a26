"""Verification of an optimum: best design and start are simulated with finer steps, more modes and finer meshes.

The gain, the constraints and the rank among the other ends of the search must hold in the finer model, see results/answer.py.
Errors are compared with what the search changed and with the sizes of the responses (`Measure.size`), so that neither the
origin, nor a unit, nor a constant in a response changes the verdict:

    the start is feasible      error of the gain         <= GAIN   |f(start) - f(best)|
    else, or best is start     error of the best value   <= GAIN   max(size, |f(start) - f(best)|)
    constraint, each row       excess                    <= LIMIT  max(size, |g(start) - g(best)|), or its own scale

So a row that is far from its limit does not change the verdict on another row. For a limit "initial", the finer model has a
limit of its own. The table shows the row of a constraint that is nearest to its limit. Over tolerances (RobustProblem) values
and errors are those of the nominal design. Ends of other starts are judged where their values lie within twice the error of
the best one.
Checked in tests/design/test_verification.py.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from torchmbd.design.problem import Problem
from torchmbd.design.problem_errors import design_errors
from torchmbd.design.problem_parts import governing_row, limits_of, masses_and_frequencies
from torchmbd.design.response import Constraint, Measure
from torchmbd.design.words import unit, words
from torchmbd.diagnosis.load_shares import notes_of_loads
from torchmbd.diagnosis.response_error import SMALL
from torchmbd.errors import InputError, MbdError, warnings_once
from torchmbd.integrate.ode import ADAPTIVE
from torchmbd.optimization import MultistartResult, OptimizationResult, Processes, RobustProblem
from torchmbd.optimization.api import FEASIBILITY
from torchmbd.optimization.optimizer import largest_violation
from torchmbd.results.answer import GAIN, LIMIT, Answer, Number, Verification
from torchmbd.results.response_error import ResponseError, rows_of

_ENDS = 3  # of other starts that are simulated, at most
_ACTIVE = 1e-3  # margin of a constraint that holds the design, a share of its size
_COUNTS = 0.1  # share of the largest error from which on an error is named as a cause
_FREQUENCIES = 2  # first ones of every body that are told
_UNRESOLVED = 16.0  # reduction of the error that is asked for where none is known: four times the steps


@warnings_once()
def verify(result: OptimizationResult | MultistartResult) -> Verification:
    """Simulate start and best design with a finer model, and compare the gain and the constraints.

    result  of `optimize` or `multistart`, of a Problem, Scenarios or RobustProblem

    The result has `verified` (True or False) and `status`, which gives the reason and advice. Its text has the objective,
    every constraint, the mass and the first frequencies of the start design and the best design, with estimated errors. A
    study calls this function at its end. Raises InputError for a result without a feasible design, and for other problems.

    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, mbd.Integral(mbd.StrainEnergy("arm")), steps=40)
    >>> verification = mbd.verify(mbd.optimize(problem, max_iterations=2))
    >>> verification.verified, verification.answers[0].goal
    (True, 'minimize')
    """
    if not isinstance(result, (OptimizationResult, MultistartResult)):
        raise InputError("result", result, "the result of mbd.optimize or mbd.optimization.multistart")
    best, feasibility, others = result, FEASIBILITY, []
    if isinstance(result, MultistartResult):
        best, feasibility, others = result.best, result.feasibility, other_ends(result)
    if best is None or not best.violation <= feasibility:  # type: ignore[union-attr]
        violation = getattr(best, "violation", None)  # None: there is no design
        text = (
            ""
            if violation is None
            else f": constraints are violated by {violation:.3g}, and {feasibility:g} is accepted"
        )
        raise InputError(
            "result",
            result,
            hint="more iterations, other starts or another limit",
            state=f"has no feasible design that could be verified{text}",
        )
    problem = best.problem  # type: ignore[union-attr]
    if isinstance(problem, Processes):
        problem = problem.problem
    if not isinstance(nominal(problem), Problem):
        raise InputError("problem", problem, "a Problem, Scenarios or RobustProblem", noun="problem of the result")
    return replace(
        verification(problem, best.x, best.value, others, feasibility=feasibility),  # type: ignore[union-attr]
        search=result.search_text,
        failing=result.failing_text,
    )


def nominal(problem: Any) -> Any:
    """The problem whose designs are simulated: of a RobustProblem the one without tolerances."""
    return problem.problem if isinstance(problem, RobustProblem) else problem


def other_ends(result: MultistartResult) -> list[OptimizationResult]:
    """The feasible ends in other minima than the best one, in the order of their values."""
    best = result.best
    if best is None:
        return []
    same = [minimum.starts for minimum in result.minima if best.start in minimum.starts]
    near = {best.start, *(start for starts in same for start in starts)}
    ends = [r for r in result.results if r.start not in near and r.violation <= result.feasibility]
    return sorted(ends, key=lambda r: r.value)


def verification(
    problem: Any,
    x: np.ndarray,
    value: float,
    others: Sequence[OptimizationResult] = (),
    start: np.ndarray | None = None,
    feasibility: float = FEASIBILITY,
) -> Verification:
    """The verification of a best design x [n] of a problem against the design `start` [n], by default that of the problem.

    value   of its objective, as minimized
    others  ends of other starts, in the order of their values
    A problem whose designs cannot be simulated with finer steps is not verified: no exception.
    """
    robust, simulated = nominal(problem) is not problem, nominal(problem)
    n, first = len(simulated.space.names), simulated.space.start
    designs = [first if start is None else start[:n], x[:n]]
    needs_first = any(c.limit == "initial" for c in simulated.constraints) and not np.array_equal(designs[0], first)
    try:
        beside = masses_and_frequencies(simulated, _FREQUENCIES)
        responses = _responses(simulated, [*designs, first] if needs_first else designs, beside)
        gained, violation = responses[0], _excess(responses, 0)
        if robust:
            gained, violation = _over_tolerances(problem, designs[0], value, gained)
        # A start beyond a limit may be better.
        claimed = not np.array_equal(*designs) and violation <= feasibility
        faults = _faults_of_gain(gained, claimed) + _faults_of_constraints(responses, 1)
        faults += [] if robust else _faults_of_order(simulated, responses, value, others)
    except MbdError as error:
        where = "see the how-to page on errors of responses"
        return Verification((), math.nan, math.nan, (str(error),), where, tuple(load_notes(simulated, x)))
    notes = _notes_of_errors(responses)
    notes += dict.fromkeys(text for response in responses for text in response.error.unknown)
    notes += load_notes(simulated, x)
    if robust:
        text = "the change of the objective is that of its {} over the tolerances, with the errors of the nominal design; {}"
        notes.append(text.format(_RULES[problem.kind], "the other values and errors are those of the nominal design"))
    changes = [100.0 * (f[1] - f[0]) / abs(f[0]) if f[0] else 0.0 for f in (gained.value, gained.finer)]
    todo = ""
    if faults:
        causes = set().union(*({"steps"} if fault.unresolved else fault.response.causes for fault in faults))
        todo = f"{advice(simulated, max(fault.need for fault in faults), causes)}, then the search again"
    answers = tuple(response.answer for response in responses)
    return Verification(answers, changes[0], changes[1], tuple(fault.text for fault in faults), todo, tuple(notes))


def load_notes(problem: Problem, x: np.ndarray) -> list[str]:
    """Return a sentence on each body whose loads were large in the motions of a design x [n]."""
    texts = (text for simulation, _ in problem.cases(x[None]) for text in notes_of_loads(simulation.system))
    return list(dict.fromkeys(texts))


def _notes_of_errors(responses: Sequence[_Response]) -> list[str]:
    """Return what the estimated errors assume: each assumption once, with the responses that have it."""
    names: dict[str, list[str]] = {}
    for response in responses:
        if response.error.note:
            names.setdefault(response.error.note, []).append(words(response.measure))
    return [f"{', '.join(dict.fromkeys(of_note))}: {note}" for note, of_note in names.items()]


_RULES = {"worst": "worst case", "expected": "mean"}


def _over_tolerances(
    problem: RobustProblem, start: np.ndarray, value: float, nominal: _Response
) -> tuple[_Response, float]:
    """The objective over tolerances of a start [n] and of the best design, and the violation of the start.

    value     of the best design, as minimized
    nominal   the objective without tolerances, whose errors are taken
    Raises MbdError for a start that cannot be evaluated within its tolerances.
    """
    x = problem.start.copy()
    x[: len(start)] = start
    [evaluation] = problem.evaluate(x[None], False)
    if not evaluation.ok:
        raise MbdError(f"the start: {evaluation.status}")
    _, evaluation = problem.with_least_bound(x, evaluation)
    values = nominal.sign * np.array([evaluation.objective, value])
    errors = (nominal.finer - nominal.value)[:2]
    equality = np.isin(np.arange(len(evaluation.constraints)), getattr(problem, "equalities", []))
    return replace(nominal, value=values, finer=values + errors), largest_violation(evaluation.constraints, equality)


@dataclass(frozen=True)
class _Response:
    """A response of several designs [lanes] in both models; of a constraint the row that governs.

    sign                  -1 for an objective that is maximized
    limit                 of a constraint [lanes]
    excess, finer_excess  the largest (g - limit) / scale of its rows, positive beyond the limit [lanes]
    beyond, share         excess in the finer model of the row for which it is the largest share of what is allowed, and this
                          share, above 1 where the constraint does not hold [lanes]
    certain               True if every row keeps its limit by more than it changes between the models [lanes]
    finer_limits          of all rows in the finer model
    size                  of the row that governs, over its scale [lanes]
    """

    goal: str
    measure: Measure
    value: np.ndarray
    finer: np.ndarray
    error: ResponseError
    sign: float = 1.0
    limit: np.ndarray | None = None
    excess: np.ndarray | None = None
    finer_excess: np.ndarray | None = None
    beyond: np.ndarray | None = None
    share: np.ndarray | None = None
    certain: np.ndarray | None = None
    finer_limits: np.ndarray | None = None
    size: np.ndarray | None = None

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why lanes are not resolved by the steps, "" where they are.

        An error of an objective that is small beside its gain needs no confirmation by further motions: an optimum of
        almost zero has no digits that steps could resolve.
        """
        if not self.is_objective:
            return self.error.reasons
        small = SMALL * abs(float(self.value[0] - self.value[1]))
        errors = rows_of(self.error.by_steps).abs().amax(1).tolist()
        return tuple("" if e <= small else reason for e, reason in zip(errors, self.error.reasons, strict=True))

    @property
    def is_objective(self) -> bool:
        """True of the response that the search minimizes or maximizes."""
        return self.goal in ("minimize", "maximize")

    @property
    def causes(self) -> set[str]:
        """The causes of the errors: "steps", "modes" or "mesh", each with an error of at least a tenth of the largest."""
        errors = {name: float(x.abs().nan_to_num().max()) for name, x in self.error.parts.items()}
        return {name for name, error in errors.items() if error >= _COUNTS * max(errors.values())}

    @property
    def answer(self) -> Answer:
        """Of the first design, the start, and the second, the best."""
        name = unit(self.measure)
        factor, name = (math.degrees(1.0), "deg") if name == "rad" else (1.0, name or "")
        changes = self.finer - self.value
        start, best = (
            Number(factor * float(self.value[k]), factor * float(changes[k]), self.reasons[k]) for k in (0, 1)
        )
        answer = Answer(self.goal, words(self.measure), name, start, best)
        if self.limit is None or self.excess is None or self.finer_excess is None or self.size is None:
            return answer
        limit, margin, finer = factor * float(self.limit[1]), -float(self.excess[1]), -float(self.finer_excess[1])
        return replace(
            answer, limit=limit, margin=margin, finer=finer, active=abs(margin) <= _ACTIVE * float(self.size[1])
        )


class _Fault(NamedTuple):
    """Why a design is not verified, and by which factor the errors of a response must fall."""

    text: str
    response: _Response
    need: float = 1.0
    unresolved: bool = False  # by the steps


def _responses(
    problem: Problem, designs: Sequence[np.ndarray], beside: Sequence[Measure], known: Sequence[_Response] = ()
) -> list[_Response]:
    """Simulate designs in both models: objective, constraints, then `beside`.

    known  responses that have the limits of the finer model; none: the initial design is among the designs, if limits need it
    """
    objective, *errors = design_errors(problem, np.stack(designs), beside)
    value, finer = (x.max(1) for x in _both(objective))
    goal = "minimize" if problem.sign > 0.0 else "maximize"
    responses = [_Response(goal, problem.stated_objective, value, finer, objective, problem.sign)]
    initial = next((k for k, x in enumerate(designs) if np.array_equal(x, problem.space.start)), None)
    count = len(problem.constraints)
    stated = zip(problem.constraints, problem.constraint_rows, errors[:count], strict=True)
    for k, (constraint, rows, error) in enumerate(stated, start=1):
        limits = problem.limits[rows]
        if known:
            limits = known[k].finer_limits
        elif constraint.limit == "initial":
            limits = limits_of(constraint, _both(error)[1][initial].reshape(-1, constraint.measure.rows)).reshape(-1)
        responses.append(_constrained(constraint, error, problem.limits[rows], limits, problem.reference.scale[rows]))
    for measure, error in zip(beside, errors[count:], strict=True):
        value, finer = _both(error)
        responses.append(_Response("", measure, value[:, 0], finer[:, 0], error))
    return responses


def _constrained(
    constraint: Constraint, error: ResponseError, limits: np.ndarray, finer_limits: Any, scale: np.ndarray
) -> _Response:
    """A constraint of several designs, of its limits [rows] in both models."""
    value, finer = _both(error)
    c, finer_c = (value - limits) / scale, (finer - finer_limits) / scale
    changes = np.abs(finer_c - c)
    sizes = rows_of(error.size if constraint.kind != "equal" else error.size.maximum(error.change)).numpy()
    size = np.ptp(value[:2], axis=0, keepdims=True).max(axis=0, initial=0.0)
    size = np.maximum(size, sizes[:2].max(0)) if constraint.scale is None else np.full_like(size, constraint.scale)
    size /= np.abs(scale)
    at = np.arange(len(value)), governing_row(constraint, c)
    excess, finer_excess = (np.abs(x) if constraint.kind == "equal" else x for x in (c, finer_c))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(finer_excess <= 0.0, 0.0, finer_excess / (LIMIT * size))
    worst = at[0], np.argmax(np.nan_to_num(shares, nan=np.inf), axis=1)
    return _Response(
        "equal to" if constraint.kind == "equal" else constraint.kind.replace("_", " "),
        constraint.measure,
        value[at],
        finer[at],
        error,
        limit=limits[at[1]],
        excess=excess.max(1),
        finer_excess=finer_excess.max(1),
        beyond=finer_excess[worst],
        share=shares[worst],
        certain=(changes < -excess).all(1),
        finer_limits=finer_limits,
        size=size[at[1]],
    )


def _both(error: ResponseError) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of a response in both models [lanes, rows]: the value, and with all its estimated errors."""
    value = rows_of(error.value).numpy()
    return value, value + sum(rows_of(x).numpy() for x in error.parts.values())


def _excess(responses: Sequence[_Response], lane: int) -> float:
    """The largest violation of a constraint of a design, 0 where all are satisfied."""
    return max((float(x.excess[lane]) for x in responses if x.excess is not None), default=0.0)


def _holds(responses: Sequence[_Response], lane: int) -> bool:
    """True if a design satisfies all constraints in the finer model."""
    return all(bool(x.share[lane] <= 1.0) for x in responses if x.share is not None)


def _faults_of_constraints(responses: Sequence[_Response], lane: int) -> list[_Fault]:
    """Constraints that do not hold in the finer model."""
    faults = []
    for response in responses:
        if response.beyond is None or response.share is None or response.certain is None:
            continue
        beyond, share, name = float(response.beyond[lane]), float(response.share[lane]), words(response.measure)
        if response.reasons[lane] and not response.certain[lane]:
            faults.append(_Fault(f"{name} is not resolved: {response.reasons[lane]}", response, _UNRESOLVED, True))
        elif not share <= 1.0:
            text = (
                f"{name} is beyond its limit by {100.0 * beyond:.3g} % in the finer model, "
                f"and at most {100.0 * beyond / share:.3g} % is accepted"
            )
            faults.append(_Fault(text, response, share if math.isfinite(share) else _UNRESOLVED))
    return faults


def _faults_of_gain(objective: _Response, claimed: bool) -> list[_Fault]:
    """Why the gain does not hold.

    claimed  whether the gain over the start is what the design is chosen for; else the value of the best design counts
    """
    counted = {"start": objective.reasons[0] if claimed else "", "best": objective.reasons[1]}
    unresolved = [
        _Fault(f"the objective of the {name} design is not resolved: {why}", objective, _UNRESOLVED, True)
        for name, why in counted.items()
        if why
    ]
    if unresolved:
        return unresolved
    (first, best), (finer_first, finer_best) = objective.value[:2], objective.finer[:2]
    gain, finer = objective.sign * (first - best), objective.sign * (finer_first - finer_best)
    if claimed and gain < 0.0:
        text = f"the best design is worse than the start, {best:.6g} against {first:.6g}"
        return [_Fault(text, objective)]
    size, error = abs(gain), abs(finer - gain)
    if not claimed:
        size, error = max(float(rows_of(objective.error.size)[1].max()), size), abs(finer_best - best)
    if error <= GAIN * size:
        return []
    need = error / (GAIN * size) if size else _UNRESOLVED
    if not claimed:
        text = (
            f"the objective of the best design has an error of {error:.3g}, "
            f"more than {100.0 * GAIN:g} % of its size {size:.3g}"
        )
        return [_Fault(text, objective, need)]
    shares = [100.0 * g / abs(f) if f else math.inf for g, f in ((gain, first), (finer, finer_first))]
    change = (
        f"; these differ by {100.0 * error / size:,.1f} %, and at most {100.0 * GAIN:g} % is accepted" if size else ""
    )
    text = (
        f"the objective improves by {gain:.4g} ({shares[0]:.4g} %), but by {finer:.4g} ({shares[1]:.4g} %) in the finer model"
        f"{change}"
    )
    return [_Fault(text, objective, need)]


def _faults_of_order(
    problem: Problem, responses: Sequence[_Response], value: float, others: Sequence[OptimizationResult]
) -> list[_Fault]:
    """Ends of other starts that are better in the finer model, of those whose values are near."""
    objective = responses[0]
    error = objective.sign * float(objective.finer[1] - objective.value[1])
    near = [end for end in others if end.value - value <= 2.0 * abs(error)][:_ENDS]
    if not near:
        return []
    n, faults = len(problem.space.names), []
    again = _responses(problem, [end.x[:n] for end in near], (), responses)
    ends = np.array([end.value for end in near]) + objective.sign * (again[0].finer - again[0].value)
    least = LIMIT * abs(float(objective.value[0] - objective.value[1]))
    for lane, end in enumerate(near):
        if value + error - ends[lane] > least and _holds(again, lane):
            numbers = (objective.sign * ends[lane], objective.sign * (value + error))
            text = "start {} is better in the finer model, {:.6g} against {:.6g}".format(end.start, *numbers)
            faults.append(_Fault(text, objective))
    return faults


_MORE = {"modes": "more modes of the flexible bodies", "mesh": "finer meshes of the flexible bodies"}


def advice(problem: Problem, need: float, causes: Collection[str] = ()) -> str:
    """What to do where errors must fall by the factor `need`, inf: nobody knows.

    causes   of the largest errors: "steps", "modes", "mesh"
    """
    more = [text for cause, text in _MORE.items() if cause in causes]
    if more:
        return " and ".join([*more, advice(problem, need)] if "steps" in causes else more)
    steps = problem.steps
    if steps is None or problem.simulation.method in ADAPTIVE:
        return "tighter tolerances of the method (rtol, atol)"
    more = math.sqrt(max(need, 4.0) if math.isfinite(need) else _UNRESOLVED) * steps
    digit = 10 ** max(len(str(int(more))) - 2, 0)
    return f"steps: {math.ceil(more / digit) * digit} or more"
