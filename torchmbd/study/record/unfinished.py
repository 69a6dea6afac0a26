"""The state of studies on disk: how to continue one that has not finished, or is not in its tracking store.

    .torchmbd/<study>/study.json     name, experiment file (null if made in Python), overrides and store; paths are relative to
                                     .torchmbd, so that all can be copied together; `id`, by which its runs are found in the
                                     store
    .torchmbd/<study>/study.lock     locked by the process that runs the study: no other can run it at the same time
    .torchmbd/<study>/journal.jsonl  its runs until they are in the store, with their files (torchmbd/tracking)

Until a study has finished, the same command continues it in the same runs. `torchmbd sync` sends the journals that processes
have left. A study that has finished is not run again, unless its store has lost it or with `fresh`.
Checked in tests/study/record/test_unfinished.py.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shlex
import shutil
import time
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from torchmbd.errors import InputError, MbdError
from torchmbd.study.record.paths import make_studies_folder, private, relative_store, studies_folder
from torchmbd.tracking.uri import StoreURI, hidden
from torchmbd.tracking.writer import JOURNAL

PARENT = "study"  # the tracker's key of the run of the whole
_FILE, _LOCK = "study.json", "study.lock"
# Of `torchmbd run`, with their defaults.
RUN_OPTIONS: dict[str, Any] = {
    "workers": 1,
    "scheduler": None,
    "fresh": False,
}


class Experiment(Protocol):
    """What is run and tracked: a study, a fit, or figures.

    name        its name
    kind        of the run in the tracking store
    experiment  of MLflow
    uri         the MLflow store; None: the default
    file, overrides  the experiment file, None if made in Python, and the overrides of the command line
    question    is the description of the run
    """

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def experiment(self) -> str: ...
    @property
    def uri(self) -> StoreURI | None: ...
    @property
    def file(self) -> Path | None: ...
    @property
    def overrides(self) -> Sequence[str]: ...
    @property
    def question(self) -> str: ...

    def resolved(self) -> dict[str, Any]:
        """Return the experiment with every default filled in, as plain data."""
        ...

    def key(self, store: StoreURI | str) -> str:
        """Return the hash of all that the results depend on: an experiment is continued by it."""
        ...


@dataclass
class StudyState:
    """The state of a study on disk."""

    folder: Path
    name: str
    file: str | None  # relative to the folder of all studies
    overrides: list[str]
    experiment: str  # of MLflow
    store: str  # URI, relative likewise
    id: str
    run_id: str = ""  # of the run in which it has finished; "": it has not finished
    ended: str = ""  # time at which it finished
    continues: bool = False  # whether an earlier process has begun it

    @property
    def path(self) -> Path | None:
        """The experiment file."""
        return None if self.file is None else Path(os.path.normpath(self.folder.parent / self.file))

    @property
    def uri(self) -> StoreURI:
        """The URI of the store; a user part is not on disk."""
        if not self.store.startswith("sqlite:///"):
            return StoreURI(self.store)
        return StoreURI(f"sqlite:///{os.path.normpath(self.folder.parent / self.store.removeprefix('sqlite:///'))}")

    def command(self, **options: Any) -> str:
        """Return the command that continues the study; `options` are those of `torchmbd run` that are not left out."""
        said = {name: value for name, value in options.items() if value != RUN_OPTIONS[name]}
        if self.path is None:
            arguments = ", ".join(f"{name}={value!r}" for name, value in said.items())
            return f"run({arguments}) of mbd.Study(..., name={self.name!r}), in Python"
        flags = [
            text for name, value in said.items() for text in (f"--{name}", *([] if value is True else [str(value)]))
        ]
        return shlex.join(["torchmbd", "run", os.path.relpath(self.path), *self.overrides, *flags])

    def mark_finished(self, run_id: str) -> None:
        """Note that the study has finished in this run."""
        self.run_id, self.ended = run_id, time.strftime("%d %b %Y %H:%M")
        with contextlib.suppress(OSError):  # full disk: the same command runs it once more
            self._write()

    def renew(self) -> None:
        """Note that the store has lost the runs: the same command makes others."""
        self.run_id, self.ended, self.id = "", "", uuid.uuid4().hex
        self._write()

    def forget(self) -> None:
        """Remove the state."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _write(self) -> None:
        draft = self.folder / f"{_FILE}.new"
        kept = {k: v for k, v in asdict(self).items() if k not in ("folder", "continues")}
        with open(draft, "w", encoding="utf-8", opener=private) as file:
            json.dump(kept, file)
            file.flush()
            os.fsync(file.fileno())  # a power cut would leave the new name to an empty file
        draft.replace(self.folder / _FILE)


@contextlib.contextmanager
def claim_study(experiment: Experiment, uri: StoreURI | str, fresh: bool = False) -> Iterator[StudyState]:
    """Lock a study for this process and yield its state; MbdError if another process runs it.

    uri    the store
    fresh  begin anew: do not continue the runs of an earlier process
    """
    folder = make_studies_folder() / experiment.key(uri)
    folder.mkdir(mode=0o700, exist_ok=True)
    with _locked(folder) as locked:
        if not locked:
            raise MbdError(f"the same study is running in another process (its folder is {folder})")
        earlier = None if fresh else _read(folder)
        file = None if experiment.file is None else os.path.relpath(experiment.file, folder.parent)
        said = [hidden(text) for text in experiment.overrides]
        where = experiment.experiment, relative_store(uri)
        study = earlier or StudyState(folder, experiment.name, file, said, *where, uuid.uuid4().hex)
        study.continues = earlier is not None
        if not study.run_id:
            study._write()
        yield study


def unsent() -> Iterator[StudyState]:
    """Yield each study that no process runs and that is not, or not wholly, in its store; meanwhile no process can run it."""
    for file in sorted(studies_folder().glob(f"*/{JOURNAL}")):
        with contextlib.suppress(FileNotFoundError), _locked(file.parent) as locked:  # it may be removed now
            study = _read(file.parent) if locked else None
            if study is not None:
                yield study


def _read(folder: Path) -> StudyState | None:
    """Return the state in a folder, None if there is none."""
    try:
        return StudyState(folder, **json.loads((folder / _FILE).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            "file",
            str(folder / _FILE),
            "the file of a study",
            noun=f"{folder / _FILE}",
            state=f"cannot be read: {error}",
            hint=f"remove {folder}, and the study begins anew",
        ) from error


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Try to lock a folder, for this process at most; yield whether it is locked."""
    with open(folder / _LOCK, "w", opener=private) as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
