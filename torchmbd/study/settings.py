"""Settings of a study, made in Python or from an experiment file: problem, start designs, method, names and units.

Checked in tests/study/test_study.py.
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
from torch import Tensor

from torchmbd.design import Tradeoff
from torchmbd.errors import InputError, argument_names, unknown
from torchmbd.math.checked_numbers import positive
from torchmbd.math.units import quantity, shown
from torchmbd.multibody.system import System
from torchmbd.optimization import OPTIMIZERS, RobustProblem, Starts
from torchmbd.optimization.api import FEASIBILITY, checked_box, require_limits
from torchmbd.optimization.discrete.grid import Grid
from torchmbd.optimization.multistart import multistart
from torchmbd.optimization.multistart.sampling import recipe, starts_at
from torchmbd.optimization.optimizer import (
    DEFAULT_METHOD,
    find_method,
    require_count,
    require_inside,
    require_method_of_size,
    require_problem,
    require_range,
)
from torchmbd.optimization.pareto import pareto_front
from torchmbd.optimization.search import TIMES
from torchmbd.results.answer import Verification
from torchmbd.study.file.schema import NAME, UNITS, StudyFile
from torchmbd.study.record.paths import relative_store, search_key
from torchmbd.study.report.columns import Columns
from torchmbd.summary import Summary, plural
from torchmbd.tracking.store import checked_uri
from torchmbd.tracking.uri import StoreURI

MAX_ITERATIONS = 60
#: Type of an option -> types of its values, in words.
_TYPES: dict[Any, tuple[Any, str]] = {
    float: (numbers.Real, "a number"),
    int: (numbers.Integral, "an integer"),
    bool: ((bool, np.bool_), "true or false"),
}
# Arguments of searches that are no options of a method.
_NO_OPTIONS = {"problem", "method", "starts", "callback", "ended", "max_iterations", "options", "progress"}


@dataclass(frozen=True)
class Origin:
    """The experiment file of a study."""

    file: Path
    overrides: tuple[str, ...]
    data: StudyFile


@dataclass(frozen=True)
class Outcome:
    """How the last run of a study ended.

    status   "FINISHED", "KILLED" (Ctrl-C, with what was computed) or "FAILED" (no start succeeded)
    result   of multistart, of pareto_front, of optimize_discrete where variables take steps, or SweepResult; None: nothing
    run_id   of the tracking store; None: it was not reached
    verification   of the best design in a finer model; None: there is none, or nothing to simulate
    """

    status: str
    result: Any
    run_id: str | None
    verification: Verification | None = None


class StudySettings(Summary):
    """The settings of a study; arguments and errors as in torchmbd.study.study.Study."""

    def __init__(
        self,
        problem: Any,
        starts: Starts | Sequence[Any] | np.ndarray | None = None,
        method: str = DEFAULT_METHOD,
        name: str = "study",
        *,
        max_iterations: int = MAX_ITERATIONS,
        increments: Mapping[str, float | Tensor] | None = None,
        sweep: Mapping[str, tuple[float, float, int]] | None = None,
        question: str = "",
        units: Mapping[str, str] | None = None,
        experiment: str = "torchmbd",
        uri: str | StoreURI | None = None,
        origin: Origin | None = None,
        **options: Any,
    ):
        require_problem(problem)
        require_limits(max_iterations, None)
        for what, text in (("name", name), ("question", question), ("experiment", experiment)):
            if not isinstance(text, str) or (what != "question" and not NAME.fullmatch(text)):
                raise InputError(what, text, "words in one line")
        self.problem: Any = problem
        self.method, self.name, self.question = method, name, question
        self.front = len(getattr(problem, "criteria", ())) > 1
        check_options(method, options, self.front)
        self.max_iterations, self.options = int(max_iterations), options
        self.experiment, self.origin = experiment, origin
        self.uri: StoreURI | None = None if uri is None else checked_uri(uri)
        self.columns = self._columns(units)
        self._start = checked_box(problem)[0]
        if sweep is None:
            require_method_of_size(method, self._start.size)
        if starts is not None and not isinstance(starts, Starts):  # extra variables begin as those of the start
            count = len(self.columns.names)
            full = [np.asarray(point, dtype=float).reshape(-1) for point in starts]
            full = [np.append(x, self._start[count:]) if x.size == count else x for x in full]
            starts = starts_at([checked_box(problem, point)[0] for point in full])
        self.starts = recipe(starts, self._start)
        self.increments = self._checked_increments(increments)
        if any(self.increments) and options.get("max_time") is not None:
            allowed = "left out where variables take steps (increments)"
            raise InputError("max_time", options["max_time"], allowed, hint="max_boxes, max_iterations")
        self.sweep = self._sweep_values(sweep)
        self.outcome: Outcome | None = None

    def _columns(self, units: Mapping[str, str] | None) -> Columns:
        names = list(self.problem.names)
        names = names[:-1] if self.has_extra_variable else names
        parameters = [name.rpartition("[")[0] or name for name in names]
        angles = {name: "deg" for name in parameters if quantity(name) == "rad"}
        if units is not None and not isinstance(units, Mapping):
            raise InputError("units", units, "a mapping parameter -> unit")
        for parameter, unit in (units or {}).items():
            if parameter not in parameters:
                raise unknown("units of parameter", parameter, dict.fromkeys(parameters), ("units", parameter))
            if unit not in UNITS:
                raise unknown("unit", unit, UNITS, ("units", parameter))
        scalars = [] if self.system is None else [n for n, x in self.system.named_parameters() if not x.ndim]
        return Columns.of(names, angles | dict(units or {}), scalars)

    def _summary(self) -> list[tuple[str, Any]]:
        variables = plural(len(self.problem.names), "design variable")
        searches = f"{variables}, {plural(self.starts.count, 'start')}, {self.method}"
        return [("name", self.name), ("question", self.question or "none"), ("problem", searches)]

    def _checked_increments(self, increments: Mapping[str, float | Tensor] | None) -> list[float | None]:
        """Return the increment of each design variable [SI], None where it takes any value."""
        if increments is not None and not isinstance(increments, Mapping):
            raise InputError("increments", increments, "a mapping parameter -> step")
        names = list(self.problem.names)
        for parameter in increments or {}:
            if all(parameter not in (name, name.rpartition("[")[0]) for name in names):
                raise unknown("increments of parameter", parameter, names, ("increments", parameter))
        # A number may be a tensor, as of mbd.deg.
        known = {name: positive(("increments", name), step, "SI") for name, step in (increments or {}).items()}
        steps = [known.get(name, known.get(name.rpartition("[")[0])) for name in names]
        if any(steps) and (self.front or self.has_extra_variable):
            rows = (
                "a front"
                if self.front
                else "an objective of several rows, such as a worst case over scenarios or at_peaks"
            )
            state, allowed = f"has a step, but the study searches for {rows}", "must have one number as objective"
            hint = "max of a history, and combine: {objective: mean} over scenarios"
            raise InputError("increments", increments, allowed, hint=hint, noun="design", state=state)
        if any(steps):
            Grid(self.problem, steps, self.problem.lower, self.problem.upper, getattr(self.problem, "period", None))
        return steps

    def _sweep_values(self, spans: Mapping[str, tuple[float, float, int]] | None) -> tuple[int, np.ndarray] | None:
        """Return the index of the swept variable and its values [SI]; None without a sweep."""
        if spans is None:
            return None
        if not isinstance(spans, Mapping) or any(np.shape(span) != (3,) for span in spans.values()):
            raise InputError("sweep", spans, "a mapping of one variable -> (first, last, count)")
        others = {"a tolerance": isinstance(self.problem, RobustProblem), "a tradeoff": self.front}
        others["a step"] = any(self.increments)
        for other, is_asked in others.items():
            if is_asked:
                raise InputError("sweep", allowed="must not be given together", state=f"and {other} are both given")
        if len(spans) != 1:
            raise InputError("sweep", spans, "must have one variable")
        if self.has_extra_variable:
            raise InputError("minimize", allowed="one number in a sweep, such as max", state="has several rows")
        [(name, span)] = spans.items()
        return sweep_values(name, span, self.problem.names, self.problem.lower, self.problem.upper)

    @property
    def simulated(self) -> Any:
        """The problem whose designs are simulated: without tolerances, the criteria of a front as rows."""
        return self.problem.problem if isinstance(self.problem, (RobustProblem, Tradeoff)) else self.problem

    def with_evaluator(self, evaluator: Any) -> Any:
        """Return the problem that optimizers see, evaluated by `evaluator` in place of `simulated`."""
        if isinstance(self.problem, RobustProblem):
            return RobustProblem(evaluator, self.problem.tolerance, self.problem.kind)
        return self.problem.over(evaluator) if isinstance(self.problem, Tradeoff) else evaluator

    @property
    def has_extra_variable(self) -> bool:
        """True if the last variable is that of a min-max problem or of a worst case, which is not a design variable."""
        return bool(getattr(self.problem, "has_extra_variable", False))

    @property
    def sign(self) -> float:
        """The factor from the objective of optimizers to that of the question: -1 where it is maximized, else 1."""
        return float(getattr(self.simulated, "sign", 1.0))

    @property
    def feasibility(self) -> float:
        """The violation of a constraint that counts as none."""
        return float(self.options.get("feasibility", FEASIBILITY))

    @property
    def system(self) -> System | None:
        return getattr(self.simulated, "system", None)

    @property
    def file(self) -> Path | None:
        """The experiment file; None: the study was made in Python."""
        return None if self.origin is None else self.origin.file

    @property
    def overrides(self) -> tuple[str, ...]:
        """The overrides of the command line."""
        return () if self.origin is None else self.origin.overrides

    def key(self, store: StoreURI | str) -> str:
        """Return the hash of all that the evaluated designs and the record of the study depend on: it is continued by it."""
        problem = self.problem
        box = [np.asarray(x, dtype=float) for x in (problem.start, problem.lower, problem.upper)]
        around = [getattr(problem, name, None) for name in ("tolerance", "kind", "criteria")]
        search = [self.points, self.method, self.max_iterations, self.options, self.increments, self.sweep]
        record = [self.name, self.experiment, list(self.columns.units), relative_store(store)]
        return search_key(self.simulated, box, around, search, record)

    @property
    def kind(self) -> str:
        """The kind of the run in the tracking store."""
        return "sweep" if self.sweep is not None else "front" if self.front else "study"

    @cached_property
    def points(self) -> np.ndarray:
        """The start designs [count, n], SI."""
        return self.starts.points(self.problem)

    def resolved(self) -> dict[str, Any]:
        """Return the study as plain data, with every default filled in, for the tracking store."""
        if self.origin is not None:
            return self.origin.data.resolved()
        problem = self.simulated
        said: dict[str, Any] = (
            {k: str(v) for k, v in problem._summary()}
            if isinstance(problem, Summary)
            else {"is": type(problem).__name__}
        )
        if isinstance(self.problem, RobustProblem):
            said |= {"tolerance": self.problem.tolerance.tolist(), "robust": self.problem.kind}
        if isinstance(self.problem, Tradeoff):
            said["criteria"] = list(self.problem.criteria)
        optimizer = {"name": self.method, "max_iterations": self.max_iterations}
        optimizer |= {k: v if isinstance(v, (bool, int, float, str)) else repr(v) for k, v in self.options.items()}
        data: dict[str, Any] = {"problem": said}
        if self.sweep is None:
            data |= {"optimizer": optimizer, "starts": {"sampler": self.starts.name, "count": self.starts.count}}
        return data | {"tracking": {"experiment": self.experiment}}


def sweep_values(
    name: str, span: tuple[float, float, int], names: Sequence[str], lower: Any, upper: Any
) -> tuple[int, np.ndarray]:
    """Return the index of a swept variable and its values; InputError for what names no variable, or leaves its bounds.

    name          label of the variable, or its parameter if that has one entry
    span          first and last value [SI], count
    names         labels of all variables
    lower, upper  their bounds [n]
    """
    entries = [k for k, label in enumerate(names) if name in (label, label.rpartition("[")[0])]
    if len(entries) != 1:
        state = "is not a single design variable"
        raise InputError(("sweep", name), span, names, noun=f"swept variable {name!r}", state=state)
    [index] = entries
    first, last, count = span
    for what, value in (("first value", first), ("last value", last)):
        require_range(f"{what} of sweep", value, -np.inf, np.inf)
    require_count("count of sweep", count, 2, 100_000)
    low, high = (np.asarray(x)[[index]] for x in (lower, upper))
    for value in (first, last):
        require_inside("sweep", [name], low, np.array([value]), high, shown)
    return index, np.linspace(first, last, count)


def check_options(method: str, options: Mapping[str, Any], front: bool) -> None:
    """InputError for options that neither the search nor the method has, or of another type; ranges the method checks."""
    search = pareto_front if front else multistart
    shared = [name for name in argument_names(search) if name not in _NO_OPTIONS]
    find_method(method, {key: x for key, x in options.items() if key not in shared}, [*shared, "max_iterations"])
    hints = get_type_hints(OPTIMIZERS[method]) | get_type_hints(search)
    for name, x in options.items():
        kind, *others = get_args(hints[name]) or (hints[name],)
        types, text = _TYPES.get(kind, (object, ""))
        if not (isinstance(x, types) and isinstance(x, bool) <= (kind is bool)) and not (x is None and others):
            raise InputError(name, x, text)
    for name, least, most in (("divisions", 1, 10_000), ("max_lanes", 1, 1_000_000), ("max_analyses", 1, 1_000_000)):
        if options.get(name) is not None:
            require_count(name, options[name], least, most)
    if options.get("max_time") is not None:
        require_range("max_time", options["max_time"], *TIMES)
    if "feasibility" in options:
        require_range("feasibility", options["feasibility"], 0.0, 1.0)
