"""A study: a problem that is optimized from several starts, tracked, continued after a kill, and reported.

    study = mbd.Study(problem, starts=mbd.optimization.sobol(8, seed=1), name="arm")
    study.check()                  what it will cost
    study.run()                    the same call continues a study that was interrupted or killed
    study.best, study.to_dataframe(), study.plot(), study.report("arm.html")
    study.verification             the best design in a finer model

`mbd.Study.from_file("arm.yaml")` makes the same object of an experiment file; `torchmbd run arm.yaml` runs it.
Checked in tests/study/test_study.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console

from torchmbd.errors import InputError
from torchmbd.results.answer import Verification
from torchmbd.study.estimate import Estimate, print_estimate
from torchmbd.study.file.load import load_study
from torchmbd.study.report.html import write_report
from torchmbd.study.run import run_study
from torchmbd.study.settings import Outcome, StudySettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class Study(StudySettings):
    """A study of a problem.

    problem         a Problem, RobustProblem or Tradeoff (a Pareto front), or another object that `optimize` takes
    starts          start designs, as in `multistart`: mbd.optimization.sobol(8, seed=1), a list of designs; None: the
                    problem's own
    method          the optimizer, as in `optimize`
    name            of the study; a study of the same name, problem and settings is continued
    max_iterations  of every start
    increments      parameter -> step of its values [SI], for variables that take steps only (mbd.deg(5) for angles)
    sweep           {entry: (first, last, count)} [SI]: evaluate along one variable, instead of searching
    question        the question of the study, one sentence: the title of its report
    units           parameter -> unit of its numbers in tables and records, "deg", "mm", ...; default: deg for ply angles
    experiment, uri   of MLflow: the name there, and the store; default: MLFLOW_TRACKING_URI, else ./mlflow.db
    origin          the experiment file that `from_file` read
    options         of the method, of `multistart`, or divisions and everywhere of `pareto_front`

    Raises InputError for anything that is wrong with it.

    >>> problem = mbd.Problem(
    ...     mbd.examples.arm(), 0.05, mbd.Integral(mbd.StrainEnergy("arm")), bounds=mbd.deg([-90, 90]), steps=20
    ... )
    >>> study = mbd.Study(problem, mbd.optimization.sobol(8, seed=1), name="arm", question="Which angles?")
    >>> study.points.shape, study.columns.names  # study.run() begins it, or goes on with it
    ((8, 2), ('angle_1_deg', 'angle_2_deg'))
    """

    @classmethod
    def from_file(cls, file: str | Path, *assignments: str) -> Self:
        """The study of an experiment file (YAML); InputError with every fault of it, each with its line.

        assignments  overrides of single values, as at the command line: "options.layers=2"
        """
        study = object.__new__(cls)
        vars(study).update(vars(load_study(file, assignments)))
        return study

    def run(
        self,
        workers: int = 1,
        scheduler: str | None = None,
        fresh: bool = False,
        console: Console | None = None,
    ) -> Self:
        """Run the study, or continue it after an interruption; returns the study.

        If the study is finished, `run` takes its results from stored evaluations.

        workers, scheduler, fresh   as in `torchmbd run`: processes that evaluate, a Dask cluster, forget stored evaluations
        console                     where it shows its progress, of rich; None: standard output; Console(quiet=True): nowhere
        A script with workers keeps what it does under `if __name__ == "__main__":`, since every process imports it.
        """
        run_study(self, console or Console(), workers=workers, scheduler=scheduler, fresh=fresh, rerun_finished=True)
        return self

    def check(self, console: Console | None = None) -> Estimate | None:
        """Evaluate a first batch, print the cost of the study, and return it; None without an mbd.Problem."""
        return print_estimate(self, console or Console())

    def report(self, path: str | Path | None = None) -> Path:
        """Write the report of the last run, one HTML file that needs nothing else, and return its path."""
        return write_report(self._ended.run_id or self.name, None if path is None else Path(path), self.uri)

    @property
    def _ended(self) -> Outcome:
        if self.outcome is None:
            raise InputError(
                "study",
                self.name,
                "run first",
                noun=f"study {self.name!r}",
                state="has not run in this process",
                hint="study.run(), which reads known evaluations from the disk",
            )
        return self.outcome

    @property
    def status(self) -> str:
        """How the last run ended: FINISHED, KILLED or FAILED."""
        return self._ended.status

    @property
    def result(self) -> Any:
        """The result of the last run: of multistart, of pareto_front, of optimize_discrete, or the points of a sweep."""
        return self._ended.result

    @property
    def best(self) -> Any:
        """The best feasible design with its objective: `.x` [SI], `.value`; None if there is none, or a front or sweep."""
        best = getattr(self.result, "best", None)
        return best if best is None or best.violation <= self.feasibility else None

    @property
    def verification(self) -> Verification | None:
        """Start and best design of the last run in a finer model (`mbd.verify`); None if nothing was simulated."""
        return self._ended.verification

    @property
    def _searches(self) -> Any:
        searches = getattr(self.result, "relaxed", self.result)
        if searches is None:
            raise InputError(
                "study",
                self.name,
                "a study whose start can be evaluated",
                noun=f"study {self.name!r}",
                state=f"ended {self.status} without a result",
            )
        return searches

    def to_dataframe(self) -> DataFrame:
        """A row for each start, or for each point of a front or of a sweep."""
        return self._searches.to_dataframe()

    def plot(self) -> Figure:
        """Figure of the convergence of all starts; of a front or a sweep, its points."""
        return self._searches.plot()

    def _summary(self) -> list[tuple[str, Any]]:
        rows = super()._summary()
        if self.outcome is None:
            return [*rows, ("status", "has not run in this process")]
        rows.append(("status", self.status))
        if (best := self.best) is not None:
            rows.append(("best", f"{best.value:.8g} at {self.columns.named(best.x)}"))
        return rows if self.verification is None else [*rows, ("verification", self.verification.status)]
