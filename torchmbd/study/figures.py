"""Figures that are no optimization: a function draws into a folder, and returns numbers and words about them.

    def figures(folder: Path, steps: int = 300) -> dict[str, float | str]

Every picture in the folder becomes an artifact of the run; numbers become metrics, words become tags, and the word of the key
"sentence" is the description of the run in MLflow. Checked in tests/study/test_figures.py.
"""

from __future__ import annotations

import math
import tempfile
from contextlib import ExitStack
from pathlib import Path

import yaml
from rich.console import Console
from rich.markup import escape

from torchmbd.errors import MbdError
from torchmbd.study.journal import PARENT, flat
from torchmbd.study.load import FiguresPlan
from torchmbd.study.model import find_function
from torchmbd.study.paths import figures_key
from torchmbd.study.run_record import RunRecord
from torchmbd.study.unfinished import claim_study
from torchmbd.tracking import MlflowTracker, Status
from torchmbd.tracking.provenance import provenance
from torchmbd.tracking.store import relative_to_store, store_uri
from torchmbd.tracking.uri import StoreURI

SENTENCE = "sentence"
PICTURES = (".png", ".pdf", ".svg", ".html", ".gif")


def run_figures(
    plan: FiguresPlan, console: Console, tracker: MlflowTracker | None = None, uri: str | StoreURI | None = None
) -> int:
    """Draw and track the figures; return the exit code. `tracker`, `uri` as in run.run_study."""
    with ExitStack() as stack:
        if tracker is not None:
            record = RunRecord(plan.name, "figures", console, lambda: tracker)
        else:
            store = store_uri(uri or plan.study.tracking.uri)
            claim = claim_study(figures_key(plan, store), plan.name, plan.file, plan.overrides, store)
            state = stack.enter_context(claim)
            tracker = MlflowTracker(plan.study.tracking.experiment, store, state.id)
            record = RunRecord(plan.name, "figures", console, lambda: tracker, state)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="torchmbd-")))
        resolved = plan.study.resolved()
        tags = {"kind": "figures", **provenance(plan.file.absolute().parent)}
        tags["mlflow.source.name"] = relative_to_store(tracker.uri, plan.file)
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
    draw = find_function(plan.study.figures, plan.file.absolute().parent)
    try:
        shown = draw(folder=folder, **plan.study.options)
    except MbdError:
        raise
    except Exception as error:  # an error of the user's function, not of torchmbd
        raise MbdError(f"{plan.study.figures}: {type(error).__name__}: {error}") from error
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
