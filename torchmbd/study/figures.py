"""Figures that are not optimization: a function draws into a folder, and returns numbers and words about them.

    def figures(folder: Path, steps: int = 300) -> dict[str, float | str]

Every picture in the folder becomes an artifact of the run; numbers become metrics, words become tags, and the word of the key
"sentence" is the description of the run in MLflow. Checked in tests/study/test_figures.py.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console
from rich.markup import escape

from torchmbd.errors import InputError, MbdError
from torchmbd.study.file.faults import Fault
from torchmbd.study.file.kind import FilePlan, Kind, Source
from torchmbd.study.file.model import find_function, option_faults, require_returns
from torchmbd.study.file.schema import FUNCTION, Tracking
from torchmbd.study.file.section import Section
from torchmbd.study.record.paths import file_key
from torchmbd.study.record.run_record import RunRecord
from torchmbd.study.record.unfinished import PARENT
from torchmbd.tracking import MlflowTracker, Status
from torchmbd.tracking.uri import StoreURI

SENTENCE = "sentence"
PICTURES = (".png", ".pdf", ".svg", ".html", ".gif")


class Figures(Section):
    """An experiment file that draws figures.

    figures   the function that draws into a folder: path/to/file.py:function or package.module:function
    options   arguments of this function; `folder` is given by the program
    tracking  where MLflow keeps the runs
    """

    figures: Annotated[str, Field(pattern=FUNCTION)]
    options: dict[str, Any] = Field(default={})
    tracking: Tracking = Tracking()

    def resolved(self) -> dict[str, Any]:
        """Return the file with every default filled in."""
        return self.model_dump(mode="json", exclude_none=True)


class FiguresPlan(FilePlan):
    """An experiment file that draws figures."""

    @property
    def kind(self) -> str:
        return "figures"

    def key(self, store: StoreURI | str) -> str:
        """Return the hash of the file, with its store."""
        return file_key(self.resolved(), self.name, store)


def _read(source: Source, sections: dict[str, Any], faults: list[Fault]) -> FiguresPlan | list[Fault]:
    """Return the figures of a file, or its faults with those of the function that draws and of its options."""
    if "figures" in sections:
        options = sections.get("options", {})
        try:
            draw = find_function(sections["figures"], source.folder)
            require_returns(sections["figures"], draw, ("dict", "Mapping"))
        except InputError as error:
            return [*faults, Fault(("figures",), error.reason)]
        faults = faults + [Fault(("options", "folder"), "is given by torchmbd")] * ("folder" in options)
        faults += option_faults(draw, {"folder": None, **options})
    return faults or FiguresPlan(Figures.model_construct(**sections), source)


def _check(plan: FiguresPlan, console: Console) -> int:
    console.print(f"{plan.source.path} is valid: figures by {plan.data.figures}", markup=False, soft_wrap=True)
    return 0


def run_figures(
    plan: FiguresPlan,
    console: Console,
    tracker: MlflowTracker | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    fresh: bool = False,
    uri: str | StoreURI | None = None,
) -> int:
    """Draw and track the figures; return the exit code. Arguments as in run.run_study; figures are always drawn."""
    if workers != 1 or scheduler is not None:
        raise InputError(
            "workers",
            workers,
            "left out, like scheduler, because one process draws the figures",
        )
    record = RunRecord(plan, console, tracker, uri)
    with record.claimed(fresh):
        record.begin({})
        record.carry_out(partial(_draw, plan, record, console))
        return record.tell_outcome()


def _draw(plan: FiguresPlan, record: RunRecord, console: Console) -> Status:
    draw = find_function(plan.data.figures, plan.source.folder)
    try:
        shown = draw(folder=record.folder, **plan.data.options)
    except MbdError:
        raise
    except Exception as error:  # an error of the user's function, not of torchmbd
        raise MbdError(f"{plan.data.figures}: {type(error).__name__}: {error}") from error
    numbers = {key: float(value) for key, value in shown.items() if not isinstance(value, str)}
    words = {key: value for key, value in shown.items() if isinstance(value, str)}
    record.tracker.metrics(PARENT, {key: value for key, value in numbers.items() if math.isfinite(value)})
    if SENTENCE in words:
        words["mlflow.note.content"] = words[SENTENCE]
        console.print(escape(words[SENTENCE]), soft_wrap=True)
    record.tracker.tags(PARENT, words)
    for file in sorted(record.folder.rglob("*")):
        if file.suffix in PICTURES:
            record.file(file, "figures")
    return "FINISHED"


FIGURES = Kind("draws figures; allowed here: a study or a sweep", Figures, _read, run_figures, _check)
