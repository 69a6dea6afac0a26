"""`identify`: unknowns of a model from measurements, by scipy.optimize.least_squares with exact Jacobians.

    experiments --simulate, forward mode--> residuals, Jacobian --SciPy--> values --linearization--> intervals

Every start is one search (least_squares.py); simulations of several starts are one batch, as those of `multistart`.
Deviations that are not given are estimated by channel from the residuals, and the fit is repeated with them.
Checked in tests/extensions/identification/test_identify.py.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from torchmbd.errors import InputError, one_of, warn, warnings_once
from torchmbd.extensions.identification.deviations import NO_FREEDOM, Group, estimated_deviations, leverages
from torchmbd.extensions.identification.experiment import Experiment
from torchmbd.extensions.identification.fit_problem import FitProblem, Residuals
from torchmbd.extensions.identification.identification import Identification, best_first
from torchmbd.extensions.identification.least_squares import TOLERANCE, Fit, FitSettings, FitStep, cost_of, fit_start
from torchmbd.extensions.identification.losses import LOSSES
from torchmbd.extensions.identification.scales import scale_of_start
from torchmbd.extensions.identification.sizes import size_doubts
from torchmbd.extensions.identification.statistics import influence
from torchmbd.extensions.identification.step_error import StepError, finer_steps, step_error
from torchmbd.math.checked_numbers import positive
from torchmbd.optimization.api import checked_box
from torchmbd.optimization.multistart.batched import BatchedSearches
from torchmbd.optimization.multistart.sampling import Starts, recipe
from torchmbd.optimization.optimizer import require_count, require_range
from torchmbd.optimization.search import deadline_of
from torchmbd.progress import both, shown, without_bars

_ROUGH = 1e-2  # tolerance of a fit that is repeated with estimated deviations
REFITS = 10  # with estimated deviations, at most
_SAME = 1e-9  # spread of the changes of deviations that moves no minimum
_SETTLED = 0.01  # change of all estimated deviations at which the fit is not repeated
_TO_NORMAL = 1.4826  # deviation of a normal distribution over the median of absolute values
_LEAST_DEVIATION = 1e-12  # of the data of a channel: of a model that fits to rounding


def identify(
    experiments: Experiment | Sequence[Experiment] | Mapping[str, Experiment],
    unknowns: Sequence[str] = (),
    bounds: Any = (-np.inf, np.inf),
    start: Any = None,
    links: Mapping[str, Mapping[str, float]] | None = None,
    priors: Mapping[str, tuple[Any, Any]] | None = None,
    scales: Mapping[str, Any] | None = None,
    validation: Experiment | Sequence[Experiment] | Mapping[str, Experiment] = (),
    loss: str = "linear",
    f_scale: float = 1.0,
    starts: Starts | Sequence[Any] | np.ndarray | None = None,
    *,
    tolerance: float = TOLERANCE,
    max_evaluations: int = 50,
    max_time: float | None = None,
    max_lanes: int = 64,
    callback: Callable[[FitStep], None] | None = None,
    progress: bool | None = None,
    evaluator: Callable[[FitProblem], FitProblem] | None = None,
) -> Identification:
    """Fit unknown parameters of a model to measurements.

    experiments      one, a list ("experiment 1", "experiment 2", ...), or name -> Experiment
    unknowns         names of parameters of their systems; all entries of each. Delays, gains and offsets of channels that are
                     mbd.variable(...) are unknowns too: "<channel>.delay"; of several experiments
                     "<experiment>.<channel>.delay"
    bounds, start, links   as in DesignSpace, by names of parameters; a delay needs finite bounds. Masses, moduli and
                     other positive parameters are at least 0
    priors           parameter name -> (mean, standard deviation): prior knowledge of an unknown
    scales           parameter name -> size of its changes; default: |start|. The data determine the scale of offsets and
                     delays, and the scale of a parameter whose start is zero or tiny compared with the range of its bounds
    validation       experiments that are held out: the fitted model is compared with them
    loss, f_scale    "linear", "soft_l1", "huber", "cauchy" or "arctan", and the residual, in deviations, beyond which one
                     counts as an outlier; as in scipy.optimize.least_squares. Priors are never outliers
    starts           mbd.optimization.sobol(...) or latin_hypercube(...), or a list of designs; None: the start alone
    tolerance        largest error of the unknowns at the end of the search, as a share of their standard deviations
    max_evaluations  simulated designs of each start at most
    max_time         limit of time [s]: no design is simulated after it, and the best by then is the result, with the status
                     "max_time"; None: no limit
    max_lanes        designs that are simulated at the same time
    callback         called with every design that lowers the cost of its start
    progress         a bar on standard error; None: in a terminal or a notebook
    evaluator        object that evaluates designs instead of the problem, such as one that stores its evaluations
                     (torchmbd.study)

    A start that cannot be simulated has the status "failed" and its reason; later designs that cannot are rejected by the
    search and counted. Raises InputError for unknown names, with the nearest; for more unknowns than numbers.

    >>> x = mbd.Position("bob", "x")
    >>> truth = mbd.simulate(mbd.examples.pendulum(speed=1.0), 2.0, steps=100)
    >>> shown = {"t": truth.t + 0.03, "x": 2.0 * x(truth)[0]}  # a sensor that is late, and shows twice the distance
    >>> sensor = mbd.identification.Channel(x, deviation=1e-3, delay=mbd.variable(0.0), gain=mbd.variable(1.0))
    >>> series = mbd.identification.TimeSeries(shown, {"x": sensor})
    >>> swing = mbd.identification.Experiment(mbd.examples.pendulum(), series, steps=100)
    >>> fit = mbd.identification.identify(swing, bounds={"x.delay": (0.0, 0.1)})
    >>> fit.status, round(fit["x.delay"], 4), round(fit["x.gain"], 4)
    ('converged', 0.03, 2.0)
    """
    deadline = deadline_of(max_time)
    problem = FitProblem(_by_name("experiments", experiments), unknowns, bounds, start, links, priors)
    held_out = _by_name("validation", validation, optional=True)
    other = problem.held_out(held_out) if held_out else None
    if evaluator is not None:
        problem, other = evaluator(problem), None if other is None else evaluator(other)
    function = LOSSES[one_of("loss", loss, LOSSES)]
    require_range("tolerance", tolerance, 1e-15, 0.1)
    require_count("max_evaluations", max_evaluations, 1, 1_000_000)
    require_count("max_lanes", max_lanes, 1, 1_000_000)
    f_scale = positive("f_scale", f_scale, "deviations")
    scale = problem.space.vector(
        "scale", scales, scale_of_start(problem.start, problem.lower, problem.upper, problem.origins)
    )
    if (scale <= 0.0).any():
        wrong = int(np.flatnonzero(scale <= 0.0)[0])
        name, value = problem.names[wrong], float(scale[wrong])
        raise InputError(("scale", name), value, "a positive number", noun=f"scale of {name}", shown=f"{value:g}")
    drawn = recipe(starts, problem.start).points(problem)
    points = np.array([checked_box(problem, point)[0] for point in drawn])  # pyright: ignore[reportArgumentType]
    settings = FitSettings(
        problem.lower, problem.upper, scale, problem.data, function, f_scale, tolerance, max_evaluations, deadline
    )
    with without_bars(), warnings_once(), shown(progress, "identify", max_evaluations * len(points)) as show:
        report = both(lambda step: show(step.evaluations, step.cost), callback)
        doubts: list[str] = []

        def begin(residuals: Residuals) -> None:
            """Compare the sizes of data and model before the search takes its time."""
            if not doubts:
                doubts.extend(size_doubts(problem, problem.predictions(residuals.values)))
                for text in doubts:
                    warn(text)

        # Where a second fit with other deviations follows, the first is not the last word.
        rough = problem.estimated and len(problem.rows) > 1
        first = replace(settings, tolerance=max(tolerance, _ROUGH)) if rough else settings
        fits = best_first(_fits(problem, points, first, report, max_lanes, begin))
        best, at_first = fits[0], problem.deviations
        first_steps = {name: steps for name, steps in problem.steps.items() if steps is not None}
        while True:
            problem, best = _with_estimates(problem, best, settings, loss, rough, report)
            error = _step_error(problem, settings, best)
            finer = {} if error is None else _finer(problem, first_steps, error)
            if not finer:
                break
            # The errors of these motions are in the unknowns: the fit goes on with finer ones.
            problem, before, rough = problem.with_steps(finer), best, False
            problem = problem if evaluator is None else evaluator(problem)
            best = _continued(problem, before, settings, report)
        ratio = at_first / problem.deviations
        others = [_in_deviations(x, problem, ratio, settings) for x in fits[1:]]
        fits = [best, *best_first(others)]  # it is the fit, even where the last deviations favor another start
    residuals = None
    if other is not None and np.isfinite(best.cost):
        [residuals] = other.evaluate(best.x[None], False)
    evaluations, failures = sum(x.evaluations for x in fits), sum(x.failures for x in fits)
    result = Identification(
        problem, settings, best, fits, evaluations, failures, other, residuals, error, tuple(doubts)
    )
    for text in result.warnings:
        warn(text)
    return result


def _with_estimates(
    problem: FitProblem, best: Fit, settings: FitSettings, loss: str, rough: bool, report: Callable[[FitStep], None]
) -> tuple[FitProblem, Fit]:
    """The fit with the deviations that its residuals have, repeated until these stay; rough: the first is not the last word."""
    for _ in range(REFITS):
        if not problem.estimated or best.status != "converged":
            return problem, best
        old, problem = problem.deviations, problem.with_deviations(_estimated(problem, best, loss))
        ratio = old / problem.deviations
        same_minimum = not len(problem.prior_rows) and loss == "linear" and np.ptp(ratio) <= _SAME * ratio.max()
        if not rough and (same_minimum or np.abs(ratio - 1.0).max() < _SETTLED):
            return problem, _in_deviations(best, problem, ratio, settings)
        best, rough = _continued(problem, best, settings, report), False
    if problem.estimated and best.status == "converged":
        best.status = "stalled"
        best.message = f"the estimated deviations change by more than {_SETTLED:.0%} after {REFITS} fits with them"
    return problem, best


def _continued(problem: FitProblem, before: Fit, settings: FitSettings, report: Callable[[FitStep], None]) -> Fit:
    """A fit that begins where another ended, and counts its evaluations."""
    fit = fit_start(problem.evaluate, before.x, settings, before.start, report)
    fit.evaluations += before.evaluations
    fit.failures += before.failures
    return fit


def _step_error(problem: FitProblem, settings: FitSettings, fit: Fit) -> StepError | None:
    """What the steps of motions do to the unknowns of a fit; None where it has not converged, or has no motion."""
    jacobian = fit.residuals.jacobian
    if fit.status != "converged" or jacobian is None:
        return None
    errors, reasons = problem.errors_by_steps(fit.x, problem.predictions(fit.residuals.values))
    if not errors and not reasons:
        return None
    searched = settings.lower < settings.upper
    size = np.fmax(fit.scale, np.abs(fit.x))
    moves, lost = influence(jacobian[:, searched], size[searched])
    moves[lost] = 0.0
    every = np.zeros((len(searched), len(jacobian)))
    every[searched] = moves
    places = {name: problem.rows_of(name) for name in errors}
    in_deviations = {name: (places[name], e / problem.deviations[places[name]]) for name, e in errors.items()}
    return step_error(in_deviations, reasons, every, np.linalg.norm(every, axis=1), np.nan_to_num(size))


def _finer(problem: FitProblem, first: Mapping[str, int], error: StepError) -> dict[str, int]:
    """More steps for experiments that leave them open, where their errors move the unknowns; none: they do not."""
    steps = {name: n for name, n in problem.steps.items() if n is not None and problem.experiments[name].steps is None}
    return {} if error.meets else finer_steps(steps, first, error)


def _by_name(what: str, experiments: Any, optional: bool = False) -> dict[str, Experiment]:
    """Experiments by name; InputError for anything else, and for none unless they are optional."""
    if isinstance(experiments, Experiment):
        return {"experiment": experiments}
    if isinstance(experiments, Sequence) and not isinstance(experiments, str):
        experiments = {f"experiment {k + 1}": x for k, x in enumerate(experiments)}
    if not isinstance(experiments, Mapping) or not (experiments or optional):
        raise InputError(
            str(what),
            experiments,
            "an mbd.identification.Experiment(...), a list of these, or a mapping name -> Experiment",
        )
    for name, x in experiments.items():
        if not isinstance(name, str) or not isinstance(x, Experiment):
            raise InputError(
                str(what), allowed="a mapping name -> mbd.identification.Experiment(...)", state=f"has {name!r}: {x!r}"
            )
    return dict(experiments)


def _fits(
    problem: FitProblem,
    points: np.ndarray,
    settings: FitSettings,
    report: Callable[[FitStep], None],
    max_lanes: int,
    begin: Callable[[Residuals], None],
) -> list[Fit]:
    """Search from every start [k, n], all simulations in common batches; `begin` has the residuals of the first start."""
    if len(points) == 1:
        return [fit_start(problem.evaluate, points[0], settings, 0, report, begin)]

    def runner(index: int, evaluate: Any, step: Any) -> Any:
        return fit_start(evaluate, points[index], settings, index, step, begin if index == 0 else None)

    runners: Any = [partial(runner, k) for k in range(len(points))]
    batched = BatchedSearches(problem, runners, max_lanes, report)  # pyright: ignore[reportArgumentType]
    fits: Any = batched.run()
    return fits


def _estimated(problem: FitProblem, fit: Fit, loss: str) -> np.ndarray:
    """Deviations of all measured numbers [data]: those given, and of the other channels those of their residuals."""
    values, jacobian = fit.residuals.values, fit.residuals.jacobian
    assert jacobian is not None
    moves = (problem.lower < fit.x) & (fit.x < problem.upper)
    size = np.fmax(fit.scale, np.abs(fit.x))[moves]
    J, result = jacobian[:, moves] * np.where(np.isfinite(size), size, 1.0), problem.deviations.copy()
    if loss == "linear":
        rest = slice(problem.data, len(values))
        groups = [Group.of(values[row.rows], J[row.rows], row.estimated) for row in problem.rows]
        groups.append(Group.of(values[rest], J[rest], False))
        sizes = estimated_deviations(groups)[:-1]
    else:
        h = leverages(J, np.ones(J.shape[1]))
        sizes = [_of_median(values[row.rows], h[row.rows]) for row in problem.rows]
    for row, size in zip(problem.rows, sizes, strict=True):
        if row.estimated:
            least = _LEAST_DEVIATION * float(np.abs(row.block.measured).max())
            result[row.rows] = np.maximum(result[row.rows] * size, max(least, np.finfo(float).tiny))
    return result


def _of_median(values: np.ndarray, h: np.ndarray) -> float:
    """The deviation of residuals with outliers; 1 where nothing is known of it. h: their leverages."""
    count = len(values)
    free = count - float(h.sum())
    return _TO_NORMAL * float(np.median(np.abs(values))) / np.sqrt(free / count) if free > NO_FREEDOM * count else 1.0


def _in_deviations(fit: Fit, problem: FitProblem, ratio: np.ndarray, settings: FitSettings) -> Fit:
    """The same fit with its residuals in other deviations; ratio: deviations before over those now [data]."""
    if not np.isfinite(fit.cost):
        return fit
    ratio = np.concatenate([ratio, np.ones(len(problem.prior_rows))])
    values, jacobian = fit.residuals.values * ratio, fit.residuals.jacobian
    jacobian = None if jacobian is None else jacobian * ratio[:, None]
    residuals = replace(fit.residuals, values=values, jacobian=jacobian)
    result = copy.copy(fit)
    result.residuals, result.cost = residuals, cost_of(values, settings)
    return result
