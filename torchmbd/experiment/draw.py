"""Figures that are no optimization: a function draws into a folder, and says in numbers and words what they show.

    def figures(folder: Path, steps: int = 300) -> dict[str, float | str]

Every picture in the folder is filed under the run; numbers become metrics, words tags, and the key "sentence" the
description that MLflow shows on top of the run. Checked in tests/experiment/test_draw.py.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import yaml
from rich.console import Console
from rich.markup import escape

from torchmbd.errors import MbdError
from torchmbd.experiment.journal import flat
from torchmbd.experiment.load import FiguresPlan
from torchmbd.experiment.model import find_function
from torchmbd.experiment.place import figures_key, place
from torchmbd.experiment.run import EXIT, close, folder_of, print_run_links
from torchmbd.tracking import ProcessTracker, Status, Tracker
from torchmbd.tracking.provenance import provenance
from torchmbd.tracking.store import store_uri

RUN, SENTENCE = "study", "sentence"
PICTURES = (".png", ".pdf", ".svg", ".html", ".gif")


def run_figures(plan: FiguresPlan, console: Console, tracker: Tracker | None = None) -> int:
    """Draw, and file what was drawn; return the exit code."""
    tracking = plan.study.tracking
    if tracker is None:
        key = figures_key(plan, store_uri(tracking.uri))
        tracker = ProcessTracker(tracking.experiment, tracking.uri, place() / key, key)
    began = time.monotonic()
    status: Status = "FAILED"
    resolved = plan.study.resolved()
    tags = {"kind": "figures", "mlflow.source.name": str(plan.file), **provenance(plan.file.absolute().parent)}
    tracker.begin(RUN, plan.name, params=flat(resolved), tags=tags)
    with folder_of(tracker) as folder:
        (folder / "config.yaml").write_text(yaml.safe_dump(resolved, sort_keys=False), encoding="utf-8")
        tracker.artifact(RUN, folder / "config.yaml")
        try:
            _draw(plan, folder, tracker, console)
            status = "FINISHED"
        except KeyboardInterrupt:
            status = "KILLED"
        finally:
            tracker.end(RUN, status)
            record = close(tracker, console)
    console.print(f"{escape(plan.name)}: {status.lower()} after {time.monotonic() - began:.1f} s")
    if record is None:
        return 1
    print_run_links(record, "figures", status, console)
    if status == "FINISHED" and isinstance(tracker, ProcessTracker):
        tracker.conclude()
    return EXIT[status]


def _draw(plan: FiguresPlan, folder: Path, tracker: Tracker, console: Console) -> None:
    draw = find_function(plan.study.figures, plan.file.absolute().parent)
    try:
        shown = draw(folder=folder, **plan.study.options)
    except MbdError:
        raise
    except Exception as error:  # the user's own code: told by its name, not as a crash of ours
        raise MbdError(f"{plan.study.figures}: {type(error).__name__}: {error}") from error
    numbers = {key: float(value) for key, value in shown.items() if not isinstance(value, str)}
    words = {key: value for key, value in shown.items() if isinstance(value, str)}
    tracker.metrics(RUN, {key: value for key, value in numbers.items() if math.isfinite(value)})
    if SENTENCE in words:
        words["mlflow.note.content"] = words[SENTENCE]
        console.print(escape(words[SENTENCE]), soft_wrap=True)
    tracker.tags(RUN, words)
    for file in sorted(folder.rglob("*")):
        if file.suffix in PICTURES:
            tracker.artifact(RUN, file, "figures")
