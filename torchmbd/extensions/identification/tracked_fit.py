"""Run an identification of an experiment file: a fit on the terminal, in the tracking store, and as a model for other studies.

    fitted.yaml                    parameters of the fitted model, which `parameters:` of any study loads (parameter_values.py)
    unknowns.csv, channels.csv     values with intervals in the units of the file; how model and data agree
    data_EXPERIMENT.CHANNEL.csv    data, model at the start and fitted model, with units in the headings
    figures/data_and_model.png     the same as a picture, and that of experiments that were held out

Every evaluation is on disk before it is used (stored_fit.py): the same command continues a fit that was killed.
Checked in tests/extensions/identification/test_files.py.
"""

from __future__ import annotations

import csv
import json
import re
from contextlib import ExitStack
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.markup import escape

from torchmbd.errors import InputError, MbdError
from torchmbd.extensions.identification.figure import data_and_model
from torchmbd.extensions.identification.fit_problem import FitProblem
from torchmbd.extensions.identification.identification import Identification
from torchmbd.extensions.identification.identify import identify
from torchmbd.extensions.identification.least_squares import FitStep
from torchmbd.extensions.identification.measurement import unit_of_title
from torchmbd.extensions.identification.plan import IdentificationPlan
from torchmbd.extensions.identification.stored_fit import StoredFit, fit_key
from torchmbd.math.units import units_of
from torchmbd.study.record.evaluations import Evaluations
from torchmbd.study.record.metric_names import DESIGN, legal_key
from torchmbd.study.record.paths import evaluations_file, numbers_key
from torchmbd.study.record.run_record import RunRecord, child
from torchmbd.study.record.unfinished import PARENT
from torchmbd.study.report.progress import print_table, table_of
from torchmbd.summary import plural
from torchmbd.tracking import MlflowTracker, Status
from torchmbd.tracking.catalog import TABLES
from torchmbd.tracking.provenance import version_of
from torchmbd.tracking.uri import StoreURI
from torchmbd.viz.figures import save, titled

UNKNOWNS, CHANNELS, FITTED = "unknowns.csv", "channels.csv", "fitted.yaml"
_TABLES = {"Unknowns": UNKNOWNS, "Model and data": CHANNELS}  # of a report
_NAME = re.compile(r"[^\w.-]+")  # what names of files do not have


def run_identification(
    plan: IdentificationPlan,
    console: Console,
    tracker: MlflowTracker | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    fresh: bool = False,
    uri: str | StoreURI | None = None,
) -> int:
    """Fit the model and track it; return the exit code. Arguments as in run.run_study."""
    if workers != 1 or scheduler is not None:
        raise InputError("workers", workers, "left out, like scheduler, because a fit runs in one process")
    with ExitStack() as stack:
        fit = _Fit(plan, console, tracker, uri, stack, fresh)
        stack.enter_context(fit.claimed(fresh))
        if (code := fit.tell_finished(f"{FITTED} in its files")) is not None:
            return code

        def run() -> Status:
            fit.begin({TABLES: json.dumps(_TABLES)})
            return fit.fit()

        fit.carry_out(run, lambda: next((x.trouble for x in fit.stores if x.trouble), None))
        hits, computed = fit.counts["hits"], fit.counts["computed"]
        known = f", {hits} of {hits + computed} evaluations known" if hits else ""
        return fit.tell_outcome(known)


class _Fit(RunRecord):
    """The record of an identification: a run for the whole, one for each start."""

    def __init__(
        self,
        plan: IdentificationPlan,
        console: Console,
        tracker: MlflowTracker | None,
        uri: str | StoreURI | None,
        stack: ExitStack,
        fresh: bool,
    ) -> None:
        super().__init__(plan, console, tracker, uri)
        self.plan, self.stack, self.fresh = plan, stack, fresh
        self.counts = {"hits": 0, "computed": 0}
        self.stores: list[Evaluations] = []
        self.begun: set[str] = set()  # starts with a run

    def fit(self) -> Status:
        """Fit, print and file the result."""
        plan, starts = self.plan, self.plan.arguments["starts"]
        count = 1 if starts is None else getattr(starts, "count", None) or len(starts)
        self.console.print(
            f"{escape(plan.name)}: {len(plan.problem.names)} unknowns, {plan.problem.data} measured numbers, "
            f"{plural(count, 'start')}",
            soft_wrap=True,
        )
        result = identify(
            plan.experiments,
            validation=plan.validation,
            callback=self._step,
            evaluator=self._stored,
            **plan.arguments,
        )
        self._print(result)
        if result.status == "interrupted":
            return "KILLED"
        numbers = {"cost": result.cost, "evaluations": float(result.evaluations), "failed_evaluations": result.failures}
        self.tracker.metrics(PARENT, {key: float(x) for key, x in numbers.items() if np.isfinite(x)})
        self.tracker.tags(PARENT, {"status": result.status, "message": result.message})
        if result.fit.residuals.jacobian is None:
            self.console.print(f"No model to report: {escape(result.message)}", style="red", soft_wrap=True)
            return "FAILED"
        names = [DESIGN + legal_key(self._heading(name, "_{}")) for name in result.names]
        values = np.array(result.x) / self._factors(result)
        self.tracker.metrics(PARENT, dict(zip(names, values.tolist(), strict=True)))
        self._write_tables(result)
        self._write_model(result)
        before = start_predictions(result.problem)
        self._draw("data_and_model", result.problem, result.residuals, before)
        self._write_data(result.problem, result.residuals, before)
        if result.validation_problem is not None and result.validation_residuals is not None:
            held, residuals = result.validation_problem, result.validation_residuals
            if residuals.ok:
                self._draw("held_out", held, residuals.values, start_predictions(held))
                self._write_data(held, residuals.values, start_predictions(held))
        return "FINISHED"

    def _stored(self, problem: FitProblem) -> FitProblem:
        """The problem with its evaluations on disk."""
        if None in problem.steps.values():
            problem.evaluate(problem.start[None], False)  # chooses the steps, the same whatever is on disk
        store = Evaluations(evaluations_file(), numbers_key(fit_key(problem)))
        self.stack.callback(store.close)
        self.stores.append(store)
        if self.fresh:
            store.forget()
        elif count := store.count():
            self.console.print(f"{count} evaluations of this problem are on disk", soft_wrap=True)
        return StoredFit.of(problem, store, self.counts)

    def _step(self, step: FitStep) -> None:
        """File a design that lowered the cost, in the run of its start."""
        run = child(step.start)
        if run not in self.begun:
            self.begun.add(run)
            self.begin_child(step.start, "start")
        self.tracker.metrics(run, {"cost": step.cost, "evaluations": float(step.evaluations)}, step.iteration)
        if not self.console.is_terminal:
            self.console.out(
                f"start {step.start:<3d} evaluations {step.evaluations:<4d} cost {step.cost:.6g}", highlight=False
            )

    def _heading(self, entry: str, form: str = " [{}]") -> str:
        """The name of an unknown without the index of a single entry, and its unit."""
        unit, parameter = self.plan.unit(entry), entry.rpartition("[")[0]
        single = self.plan.problem.space.shapes[parameter].numel() == 1
        return (parameter if single else entry) + ("" if unit == "none" else form.format(unit))

    def _factors(self, result: Identification) -> np.ndarray:
        return np.array([self.plan.factor(name) for name in result.names])

    def _print(self, result: Identification) -> None:
        """Print unknowns with their intervals, in the units of the file, and what else the fit says."""
        if result.fit.residuals.jacobian is not None:
            table = table_of(f"{self.plan.name}: {result.status}", ["unknown", "start", "value", "+- (95 %)", "remark"])
            half = result.half_width if result.converged else np.full(len(result.x), np.nan)
            for k, (name, remark) in enumerate(zip(result.names, result.remarks, strict=True)):
                x, first, width = (y[k] / self.plan.factor(name) for y in (result.x, result.start, half))
                interval = f"{width:.2g}" if np.isfinite(width) else "-"
                table.add_row(escape(self._heading(name)), f"{first:.6g}", f"{x:.6g}", interval, remark)
            print_table(table, self.console)
        rows = [(label, text) for label, text in result._summary() if label not in result.names]
        for label, text in rows:
            self.console.print(f"{label}: {text}", soft_wrap=True, highlight=False, markup=False)

    def _write_tables(self, result: Identification) -> None:
        frame = result.to_frame()
        for column in ("value", "deviation", "low", "high", "start", "lower", "upper"):
            frame[column] = frame[column] / self._factors(result)
        frame.insert(0, "unit", [self.plan.unit(name) for name in result.names])
        self._frame(UNKNOWNS, frame)
        channels = result.channels_frame()
        blocks = {row.name: row.block.title for row in result.problem.rows}
        if result.validation_problem is not None:
            blocks |= {row.name: row.block.title for row in result.validation_problem.rows}
        channels.insert(0, "unit", [unit_of_title(blocks.get(name, "")) for name in channels.index])
        self._frame(CHANNELS, channels)

    def _frame(self, name: str, frame: Any) -> None:
        frame.to_csv(self.folder / name)
        self.file(self.folder / name)

    def _write_model(self, result: Identification) -> None:
        """Write the parameters of the fitted model, and the numbers of sensors, which no model has, as comments."""
        of_model: dict[str, Any] = {}
        comments = [
            f"Fitted by {self.plan.source.path.name}, torchmbd {version_of('torchmbd') or ''}; "
            f"parameters: {FITTED} in an experiment file"
        ]
        systems = {name for x in self.plan.experiments.values() for name, _ in x.system.named_parameters()}
        for name, x in result.designs.items():
            unit, factor = self.plan.unit(name), self.plan.factor(name)
            numbers = [float(y) for y in (x[0].reshape(-1) / factor).tolist()]
            value = numbers[0] if x[0].dim() == 0 else numbers
            if name in systems:
                of_model[name] = {"value": value, "unit": unit}
            else:
                comments.append(f"{name}: {value} {'' if unit == 'none' else unit}".rstrip())
        text = "".join(f"# {line}\n" for line in comments)
        self.text(FITTED, text + yaml.safe_dump(of_model, sort_keys=False, default_flow_style=None))

    def _draw(self, name: str, problem: FitProblem, values: np.ndarray, before: np.ndarray | None) -> None:
        shown = problem.predictions(values)
        panels = [
            (r.name, r.block.title, r.block.abscissa, r.block.x, r.block.measured, shown[r.rows]) for r in problem.rows
        ]
        start = None if before is None else [before[r.rows] for r in problem.rows]
        try:
            figure = titled(data_and_model(panels, start), self.plan.question or self.plan.name)
            self.file(save(figure, self.folder / f"{name}.png"), "figures")
        except (MbdError, OSError, ValueError) as error:  # the fit goes on without the picture
            self.console.print(f"No picture: {escape(str(error))}", style="red", soft_wrap=True)

    def _write_data(self, problem: FitProblem, values: np.ndarray, before: np.ndarray | None) -> None:
        """Write data and models of every channel, with units in the headings."""
        shown = problem.predictions(values)
        for row in problem.rows:
            block, unit = row.block, unit_of_title(row.block.title)
            over = block.abscissa.replace("time [s]", "t [s]")
            columns = {over: block.x, _with_unit("data", unit): block.measured}
            columns |= {} if before is None else {_with_unit("start", unit): before[row.rows]}
            columns[_with_unit("fitted", unit)] = shown[row.rows]
            file = self.folder / f"data_{_NAME.sub('_', f'{row.experiment}.{row.block.channel}')}.csv"
            with file.open("w", newline="", encoding="utf-8") as out:
                writer = csv.writer(out)
                writer.writerow(columns)
                writer.writerows(zip(*(x.tolist() for x in columns.values()), strict=True))
            self.file(file)


def start_predictions(problem: FitProblem) -> np.ndarray | None:
    """Numbers of the model at the start [data], SI; None where it cannot be simulated."""
    [residuals] = problem.evaluate(problem.start[None], False)
    return problem.predictions(residuals.values) if residuals.ok else None


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit and units_of(unit) else name
