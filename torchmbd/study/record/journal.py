"""The runs of a study in the tracking store: a parent, and a child for each start, point of a front or point of a sweep.

parent   params: the resolved file; tags: versions, commit, machine, seed; metrics: best_objective over iterations,
         evaluations; names as in metric_names.py; files: config, best design, figures, animation, table
child    params: start design; metrics over iterations: objective, violation, constraints, design,
         analyses; at the end reduction_percent, iterations, failed evaluations; tags: status, message, best
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from rich.console import Console

from torchmbd.math.units import UNITS
from torchmbd.optimization.optimizer import Evaluation, Iterate, OptimizationResult
from torchmbd.results.answer import Verification
from torchmbd.study.record.metric_names import (
    ANALYSES,
    BEST,
    CONSTRAINT,
    CRITERION,
    DESIGN,
    ERROR,
    EVALUATIONS,
    FAILED,
    ITERATIONS,
    MARGIN,
    SEARCH,
    START,
    constraint_names,
    gain_metric,
    legal_key,
    unique,
)
from torchmbd.study.record.paths import problem_key
from torchmbd.study.record.run_record import RunRecord, child
from torchmbd.study.record.unfinished import PARENT
from torchmbd.study.report.answers import ANSWER
from torchmbd.study.settings import StudySettings
from torchmbd.tracking import MlflowTracker, Status
from torchmbd.tracking.catalog import GOAL, MAXIMIZE, VERIFICATION
from torchmbd.tracking.uri import StoreURI

NOTE = "mlflow.note.content"  # tag of the description of a run
STATUS_COLUMN = "attributes.Description"  # MLflow shows attributes before metrics, and tags behind all of them


class Journal(RunRecord):
    """The record of a study: translates iterates, evaluations and results into calls of a tracker."""

    def __init__(
        self,
        study: StudySettings,
        console: Console,
        tracker: MlflowTracker | None = None,
        uri: str | StoreURI | None = None,
    ) -> None:
        super().__init__(study, console, tracker, uri)
        self.study = study
        self.first: dict[int, float] = {}  # objective of the first iterate of each start
        self.evaluations = self.iterates = 0
        self.failures: list[str] = []  # reason and design of each failed evaluation
        self._best, self._accuracy = math.inf, ""

    def begin_study(self) -> None:
        """Open the parent run, with the table of its children."""
        study, origin, kind = self.study, self.study.origin, self.study.kind
        tags = {"problem_key": problem_key(study.simulated)}
        tags |= {GOAL: MAXIMIZE} if study.sign < 0.0 else {}
        tags |= {"seed": str(origin.data.starts.seed)} if origin is not None and origin.data.starts is not None else {}
        self.begin(tags)
        groups = [
            group.rstrip("/")
            for group in (CRITERION, CONSTRAINT, DESIGN, SEARCH)
            if group != CRITERION or kind == "front"
        ]
        self.tracker.view(PARENT, self._columns(kind), "metrics.objective", study.sign > 0.0, groups)

    def _columns(self, kind: str) -> list[str]:
        """Return the columns of the table of the children in MLflow."""
        extra_metrics = {"sweep": ["ratio"], "front": ["violation"]}.get(
            kind, [gain_metric(self.study.sign), "violation", ITERATIONS, FAILED]
        )
        first = list(self.criteria.values()) if kind == "front" else ["objective"]
        names = [*first, *extra_metrics, *(DESIGN + name for name in self.study.columns.names)]
        return [STATUS_COLUMN, *(f"metrics.{name}" for name in names)]

    @property
    def criteria(self) -> dict[str, str]:
        """The metrics of the criteria of a front by criterion, with known units: `criterion/mass_kg`."""
        problem = self.study.problem
        units = getattr(problem, "units", [None] * len(problem.criteria))
        ends = [f"_{unit}" if unit in UNITS else "" for unit in units]
        return {name: CRITERION + legal_key(name + end) for name, end in zip(problem.criteria, ends, strict=True)}

    def begin_start(self, index: int, x: np.ndarray, kind: str = "start") -> None:
        """Open the child of a start, or of a point of a sweep."""
        shown = self.study.columns.by_name(x)
        self.begin_child(index, kind, {f"start_{name}": f"{value:.6g}" for name, value in shown.items()})

    def design_metrics(self, x: np.ndarray) -> dict[str, float]:
        """Return the metrics of a design [SI]."""
        return {DESIGN + name: value for name, value in self.study.columns.by_name(x).items()}

    def constraints(self, values: Any) -> dict[str, float]:
        """Return the metrics of the rows of the constraints."""
        rows = np.atleast_1d(values).tolist()
        return dict(zip(constraint_names(getattr(self.study, "problem", None), len(rows)), rows, strict=True))

    def iterate(self, iterate: Iterate) -> None:
        """Log one iterate of one start."""
        self.iterates += 1
        run = child(iterate.start)
        numbers = {
            "objective": self.study.sign * iterate.objective,
            "violation": iterate.violation,
            ANALYSES: iterate.analyses,
            **self.constraints(iterate.constraints),
            **self.design_metrics(iterate.x),
        }
        self.tracker.metrics(run, _finite(numbers), iterate.iteration)
        if iterate.iteration == 0:
            self.first[iterate.start] = iterate.objective
        if iterate.accuracy != self._accuracy:  # values by other steps are no improvement
            self._best, self._accuracy = math.inf, iterate.accuracy
        if iterate.status != "ok":
            self.tracker.tags(run, {"last_failure": iterate.status})
        elif iterate.violation <= self.study.feasibility and iterate.objective < self._best:
            self._best = iterate.objective
            self.tracker.metrics(PARENT, {"best_objective": self.study.sign * self._best}, self.iterates)

    def evaluated(self, X: np.ndarray, evaluations: Sequence[Evaluation]) -> None:
        """Count a batch of evaluations of designs [lanes, n]; the last that failed is a tag."""
        self.evaluations += len(evaluations)
        for x, evaluation in zip(X, evaluations, strict=True):
            if evaluation.status != "ok":
                self.failures.append(f"{evaluation.status} (design {self.study.columns.sentence(x)})")
        counts = {EVALUATIONS: self.evaluations, FAILED: len(self.failures)}
        self.tracker.metrics(PARENT, counts, self.evaluations)
        if self.failures:
            self.tracker.tags(PARENT, {"last_failure": self.failures[-1]})

    def result(self, result: OptimizationResult) -> None:
        """Close the child of a start with its final numbers."""
        run = child(result.start)
        if result.history:  # the start by the steps of the result
            self.first[result.start] = result.history[0].objective
        last = max(result.iterations, len(result.history) - 1, 0)
        self.tracker.metrics(run, self.last_numbers(result), last)
        self.ended(result.start, result)
        self.tracker.tags(run, {"method": result.method, "best": "false"})
        statuses: dict[str, Status] = {"failed": "FAILED", "interrupted": "KILLED"}
        self.tracker.end(run, statuses.get(result.status, "FINISHED"))

    def last_numbers(self, result: OptimizationResult) -> dict[str, float]:
        """Return the final metrics of a start."""
        numbers = {
            "objective": self.study.sign * result.value,
            "violation": result.violation,
            ANALYSES: result.analyses,
            ITERATIONS: result.iterations,
            FAILED: result.failures,
            gain_metric(self.study.sign): percent(self.first.get(0, math.nan), result.value),
            **self.design_metrics(result.x),
        }
        return _finite(numbers)

    def ended(self, index: int, result: OptimizationResult) -> None:
        """Tag a child with how its search ended; its description has it for the table."""
        words = {"status": result.status, "message": result.message, NOTE: result.status.replace("_", " ")}
        self.tracker.tags(child(index), words)

    def summary(self, numbers: Mapping[str, float], tags: Mapping[str, str]) -> None:
        """Log the outcome of the whole study on the parent."""
        self.tracker.metrics(PARENT, _finite(numbers), self.iterates)
        self.tracker.tags(PARENT, tags)

    def outcome(self, x: np.ndarray, value: float, violation: float) -> None:
        """Log the design of the study [SI], its minimized objective and violation, and the gain over start 0."""
        sign, initial = self.study.sign, self.first.get(0, math.nan)
        objectives = dict.fromkeys(("objective", "best_objective"), sign * value)
        gain = {gain_metric(sign): percent(initial, value)} if initial else {}
        self.summary(objectives | {"violation": violation} | gain | self.design_metrics(x), {})

    def best(self, result: OptimizationResult) -> None:
        """Mark the best start, and write its design."""
        self.tracker.tags(child(result.start), {"best": "true"})
        self.design(result.x)

    def verified(self, verification: Verification) -> None:
        """File the responses of start and best design with their errors, and whether the best design is verified."""
        ends = [f"_{answer.unit}" if answer.unit in UNITS else "" for answer in verification.answers]
        names = unique([legal_key(answer.words + end) for answer, end in zip(verification.answers, ends, strict=True)])
        numbers: dict[str, float] = {}
        for name, answer in zip(names, verification.answers, strict=True):
            numbers |= {
                START + name: answer.start.value,
                BEST + name: answer.best.value,
                ERROR + name: answer.best.error,
            }
            numbers |= {} if answer.margin is None else {MARGIN + name: answer.margin}
        self.summary(numbers, {VERIFICATION: verification.status})
        self.text(ANSWER, verification.to_json())

    def design(self, x: np.ndarray) -> None:
        """Write the best design [SI] by the names of the parameters, for torchmbd.study.record.stored_run."""
        values: dict[str, list[float]] = {}
        space = getattr(self.study.simulated, "space", None)
        if space is not None:  # with the entries that follow others
            designs = space.designs(np.asarray(x)[None, : len(space.names)])
            values = {name: entries.reshape(-1).tolist() for name, entries in designs.items()}
        else:
            for label, value in zip(self.study.columns.labels, x.tolist(), strict=False):
                values.setdefault(label.rpartition("[")[0] or label, []).append(value)
        self.text("design.yaml", yaml.safe_dump(values, sort_keys=False))


def percent(first: float, last: float) -> float:
    """Return the reduction from `first` to `last` in percent; nan if `first` is zero."""
    return 100.0 * (first - last) / abs(first) if first else math.nan


def _finite(numbers: Mapping[str, float]) -> dict[str, float]:
    """Return the finite numbers: those of a failed evaluation are not logged."""
    return {key: float(value) for key, value in numbers.items() if math.isfinite(value)}
