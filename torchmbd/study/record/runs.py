"""The runs of an experiment in the tracking store: a parent with the experiment file, and a child for each start or point.

Checked in tests/study/record/test_journal.py, test_figures.py, test_disks.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from torchmbd.study.file.yaml_file import without_user
from torchmbd.study.record.metric_names import legal_key
from torchmbd.tracking import MlflowTracker
from torchmbd.tracking.provenance import provenance
from torchmbd.tracking.store import relative_to_store
from torchmbd.tracking.uri import hidden

PARENT = "study"


class Runs:
    """Opens the runs of an experiment, and keeps their files.

    folder   where files are written before the tracker takes them
    trouble  why a file could not be written
    """

    def __init__(self, tracker: MlflowTracker, folder: Path) -> None:
        self.tracker, self.folder = tracker, folder
        self.trouble: str | None = None

    def begin(
        self,
        name: str,
        resolved: Mapping[str, Any],
        tags: Mapping[str, str],
        file: Path | None = None,
        overrides: Sequence[str] = (),
        question: str = "",
    ) -> None:
        """Open the parent; its tags say where the experiment comes from, its files are the experiment file as it was read.

        resolved         the experiment with every default filled in, as plain data
        file, overrides  of the command line; None: made in Python
        question         is the description of the run
        """
        origin: dict[str, str] = {**tags, **provenance(Path() if file is None else file.absolute().parent)}
        if question:
            origin["question"] = origin["mlflow.note.content"] = question
        if file is not None:
            origin["mlflow.source.name"] = relative_to_store(self.tracker.uri, file)
            origin |= {"overrides": hidden(" ".join(overrides))} if overrides else {}
        self.tracker.begin(PARENT, name, params=flat(resolved), tags=origin)
        self.text("config.yaml", yaml.safe_dump(dict(resolved), sort_keys=False))
        if file is not None and file.is_file():
            self.text("config_as_given.yaml", without_user(file.read_text(encoding="utf-8")))

    def begin_child(self, index: int, kind: str, params: Mapping[str, object] = {}) -> None:
        """Open the child of a start or a point."""
        name = f"{kind} {index}"
        self.tracker.begin(child(index), name, parent=PARENT, params={kind: index, **params}, tags={"kind": kind})

    def text(self, name: str, content: str) -> None:
        """Write a text file as an artifact; a full disk loses the file, not the study."""
        try:
            (self.folder / name).write_text(content, encoding="utf-8")
        except OSError as error:
            self.trouble = f"{name} cannot be written: {error.strerror}"
        else:
            self.file(self.folder / name)

    def file(self, path: Path, folder: str = "") -> None:
        """Make a file an artifact of the parent."""
        self.tracker.artifact(PARENT, path, folder)


def child(index: int) -> str:
    """Return the tracker's key of a start."""
    return f"start_{index}"


def flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """Flatten nested mappings, and lists of them, to dotted keys: `optimizer.name`, `subject_to.0.at_most`."""
    result: dict[str, object] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            result |= flat(value, f"{prefix}{key}.")
        elif isinstance(value, (list, tuple)) and any(isinstance(entry, Mapping) for entry in value):
            result |= flat({str(k): entry for k, entry in enumerate(value)}, f"{prefix}{key}.")
        else:
            result[legal_key(f"{prefix}{key}")] = value
    return result
