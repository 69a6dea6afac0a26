"""Figures that are no optimization: a function draws into a folder, and returns numbers and words about them.

    def figures(folder: Path, steps: int = 300) -> dict[str, float | str]

Every picture in the folder becomes an artifact of the run; numbers become metrics, words become tags, and the word of the key
"sentence" is the description of the run in MLflow. Checked in tests/study/test_figures.py.
"""

from __future__ import annotations

import math
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.markup import escape

from torchmbd.errors import InputError, MbdError
from torchmbd.study.file_errors import Fault
from torchmbd.study.journal import PARENT, flat
from torchmbd.study.kind import Kind, Source
from torchmbd.study.model import find_function, option_faults, require_returns
from torchmbd.study.paths import file_key
from torchmbd.study.run_record import RunRecord
from torchmbd.study.schema import Figures
from torchmbd.study.unfinished import claim_study
from torchmbd.tracking import MlflowTracker, Status
from torchmbd.tracking.provenance import provenance
from torchmbd.tracking.store import relative_to_store, store_uri
from torchmbd.tracking.uri import StoreURI

SENTENCE = "sentence"
PICTURES = (".png", ".pdf", ".svg", ".html", ".gif")


@dataclass(frozen=True)
class FiguresPlan:
    """An experiment file that draws figures."""

    data: Figures
    source: Source

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def uri(self) -> StoreURI | None:
        return self.data.tracking.uri


def _read(source: Source, sections: dict[str, Any], faults: list[Fault]) -> FiguresPlan | list[Fault]:
    """Return the figures of a file, or its faults with those of the function that draws and of its options."""
    if "figures" in sections:
        options = sections.get("options", {})
        try:
            draw = find_function(sections["figures"], source.folder)
            require_returns(sections["figures"], draw, ("dict", "Mapping"))
        except InputError as error:
            return [*faults, Fault(("figures",), str(error))]
        faults = faults + [Fault(("options", "folder"), "is given by torchmbd")] * ("folder" in options)
        faults += option_faults(draw, {"folder": None, **options})
    return faults or FiguresPlan(Figures.model_construct(**sections), source)


def figures_key(plan: FiguresPlan, uri: StoreURI | str) -> str:
    """Return the hash of an experiment file of figures, with its store."""
    return file_key(plan.data.resolved(), plan.name, uri)


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
    offline: bool = False,
) -> int:
    """Draw and track the figures; return the exit code. Arguments as of run.run_study; figures are always drawn."""
    if workers != 1 or scheduler is not None:
        raise InputError("workers and scheduler: figures are drawn in one process; allowed: torchmbd run without them")
    source = plan.source
    with ExitStack() as stack:
        if tracker is not None:
            record = RunRecord(plan.name, "figures", console, lambda: tracker)
        else:
            store = store_uri(uri or plan.uri)
            claim = claim_study(figures_key(plan, store), plan.name, source.path, source.overrides, store, fresh)
            state = stack.enter_context(claim)
            tracker = MlflowTracker(plan.data.tracking.experiment, store, state.id)
            record = RunRecord(plan.name, "figures", console, lambda: tracker, state)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="torchmbd-")))
        resolved = plan.data.resolved()
        tags = {"kind": "figures", **provenance(source.folder)}
        tags["mlflow.source.name"] = relative_to_store(tracker.uri, source.path)
        tracker.begin(PARENT, plan.name, params=flat(resolved), tags=tags)
        (folder / "config.yaml").write_text(yaml.safe_dump(resolved, sort_keys=False), encoding="utf-8")
        tracker.artifact(PARENT, folder / "config.yaml")
        status: Status = "FAILED"
        try:
            _draw(plan, folder, tracker, console)
            status = "FINISHED"
        except KeyboardInterrupt:
            status = "KILLED"
        finally:
            tracker.end(PARENT, status)
            record.close()
        return record.tell_outcome(status)


def _draw(plan: FiguresPlan, folder: Path, tracker: MlflowTracker, console: Console) -> None:
    draw = find_function(plan.data.figures, plan.source.folder)
    try:
        shown = draw(folder=folder, **plan.data.options)
    except MbdError:
        raise
    except Exception as error:  # an error of the user's function, not of torchmbd
        raise MbdError(f"{plan.data.figures}: {type(error).__name__}: {error}") from error
    numbers = {key: float(value) for key, value in shown.items() if not isinstance(value, str)}
    words = {key: value for key, value in shown.items() if isinstance(value, str)}
    tracker.metrics(PARENT, {key: value for key, value in numbers.items() if math.isfinite(value)})
    if SENTENCE in words:
        words["mlflow.note.content"] = words[SENTENCE]
        console.print(escape(words[SENTENCE]), soft_wrap=True)
    tracker.tags(PARENT, words)
    for file in sorted(folder.rglob("*")):
        if file.suffix in PICTURES:
            tracker.artifact(PARENT, file, "figures")


FIGURES = Kind("draws figures; allowed here: a study or a sweep", Figures, _read, figures_key, run_figures, _check)
