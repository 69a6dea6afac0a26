"""The journal of a study's runs, which a writer brings into an MLflow store: a study waits for the store only at its end.

    study                              journal, the record on disk           writer (writer.py)
    metrics("start_3", {...}, 7)  ->   {"run": "start_3", "metrics": ...} -> MlflowClient.log_batch, every few seconds
    close()                       ->   the rest; then the Record

    begin    open a run under a key ("study", "start_3"), perhaps as the child of another
    metrics  log numbers of one step (an iteration)
    tags     log words
    artifact log a file
    view     define the table of the children: metrics, parameters and tags
    end      end a run: FINISHED, FAILED or KILLED
    end_all  end every run that is open
    close    end open runs as KILLED, wait for the store, return where the runs are
    left     the tracker of a journal that an earlier process has left: `close` sends it

Each call is a line of the journal, a part of a run in JSON with the time of the call. If the disk is full, lines wait in
memory. The writer reads the lines in another process, so that importing and calling MLflow takes no time of the search. If
MLflow is imported here already, the writer is a thread. If its process is killed, another one reads the journal again.
The journal and the files of the runs remain in the folder of a study until they are in the store.

To send a part again changes nothing in the store. So the writer sends again whatever fails until the store answers, or until
`TORCHMBD_PATIENCE` seconds (default 15) after the end of the study. `close` names what the store refuses, such as a file that
does not exist; everything else is sent.

`study` is the same for all processes that run a study: one that continues a killed study finds its runs by the tags study_key
and run_key, and writes no metric twice. Whoever reads the store next ends the runs of a process that was killed
(run_process.py). Checked in tests/tracking/test_tracker.py, test_writer.py.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from torchmbd.process import utf8
from torchmbd.tracking.run_process import process_tag
from torchmbd.tracking.store import Status, TrackingError, store_uri
from torchmbd.tracking.uri import StoreURI
from torchmbd.tracking.writer import JOURNAL, RECORD, Part, Record, Writer, read_record, whole_lines

FILES = "files"  # tag of a run that is over: the names of its files, one a line
_FOLDER = "files"  # of a journal: files that become artifacts
PATIENCE = "TORCHMBD_PATIENCE"  # environment variable: seconds to wait for a store that is away when the study is over
_RETRY = 0.5  # seconds until a full disk, or a writer that was killed, is tried again after the study
_MAX_VALUE = 6000  # characters of a parameter; MLflow's own limit
_UNGROUPED = "Model metrics"  # section of charts of metrics without a group, by MLflow
_SERVE = "import sys; sys.path[:] = {path!r}; from torchmbd.tracking.writer import serve; serve()"


class MlflowTracker:
    """Logs the runs of a study, see the header of this file.

    study   key of the study, whose runs are continued; None: a new study
    folder  of the journal, whose record of an earlier process is removed; None: a temporary one, which `close` removes
    """

    def __init__(
        self,
        experiment: str,
        uri: str | StoreURI | None = None,
        study: str | None = None,
        folder: Path | None = None,
    ) -> None:
        self.experiment, self.uri = experiment, store_uri(uri)
        self.study = study or uuid.uuid4().hex
        self._status: dict[str, Status | None] = {}  # of every run that has begun; None: it is open
        self._files: dict[str, set[str]] = {}  # names of the files of every run
        self._began = self._ended = 0  # ms since 1970, of the first run to begin and the last to end
        self._last = 0  # ms since 1970 of the last metric
        self._folder = folder
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        if folder is not None:
            _remove_record(folder)
        self._lines = b""  # not in the journal yet
        self._fault: str | None = None  # why the journal or its writer cannot be had
        self._record: Record | None = None  # the last one, after `close`
        self._writer: Writer | None = None  # in the thread
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[bytes] | None = None

    @classmethod
    def left(cls, experiment: str, uri: StoreURI, study: str, folder: Path) -> Self:
        """The tracker of a journal in a folder, whose process has ended: what this has left open is KILLED.

        TrackingError for a journal that cannot be read, as after a power cut: the study itself makes it anew.
        """
        tracker = cls(experiment, uri, study)
        tracker._folder = folder
        whole = whole_lines((folder / JOURNAL).read_bytes())
        try:
            parts = [json.loads(line) for line in whole.splitlines()]
        except ValueError as error:
            raise TrackingError(f"{folder / JOURNAL} cannot be read: {error}. Try: torchmbd run") from error
        os.truncate(folder / JOURNAL, len(whole))  # the process may have been killed within a line
        (folder / RECORD).unlink(missing_ok=True)  # of the writer of that process
        for part in parts:
            tracker._note(part)
        for run in tracker._open_runs():
            tracker._end(run, "KILLED", parts[-1]["when"])
        return tracker

    @property
    def folder(self) -> Path:
        """The folder of the journal."""
        if self._folder is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="torchmbd-")
            self._folder = Path(self._temporary.name)
        return self._folder

    @property
    def files(self) -> Path:
        """The folder for files that become artifacts: they remain until they are in the store."""
        files = self.folder / _FOLDER
        files.mkdir(exist_ok=True)
        return files

    @property
    def statuses(self) -> dict[str, Status | None]:
        """The status of every run that has begun; None: it is open."""
        return dict(self._status)

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        if run in self._status:
            raise TrackingError(f"run {run!r} has begun already")
        if parent is not None:
            self._require(parent)
        self._status[run] = None
        texts = {key: value[:_MAX_VALUE] for key, value in _texts(params or {}).items()}
        self._log(run, _now(), name=utf8(name), parent=parent, params=texts, tags=_texts(tags or {}))

    def metrics(self, run: str, values: Mapping[str, float], step: int = 0) -> None:
        self._last = max(_now(), self._last + 1)  # the later of two at one step is the last one
        self._log(run, self._last, metrics={key: float(value) for key, value in values.items()}, step=step)

    def tags(self, run: str, values: Mapping[str, str]) -> None:
        self._log(run, _now(), tags=_texts(values))

    def artifact(self, run: str, file: str | Path, folder: str = "") -> None:
        """Log a file, which must exist until `close` has returned."""
        self._log(run, _now(), file=os.path.relpath(file, self.folder), folder=folder)

    def view(
        self, run: str, columns: Sequence[str], order_by: str, ascending: bool = True, groups: Sequence[str] = ()
    ) -> None:
        """Store a view of the run's children that `links.view_link` opens.

        columns, order_by   `metrics.objective`, `params.start`, `tags.status`
        groups              of metrics, the part before the last `/`: their charts are below the others, folded
        """
        sections = [
            {"uuid": name, "name": name, "display": name == _UNGROUPED, "isReordered": False, "isGenerated": True}
            for name in (_UNGROUPED, *groups)
        ]
        state = {
            "orderByKey": _quoted(order_by),
            "orderByAsc": ascending,
            "startTime": "ALL",
            "lifecycleFilter": "Active",
            "selectedColumns": [_quoted(column) for column in columns],
            "runsHiddenMode": "SHOW_ALL",
            "compareRunCharts": [],  # MLflow adds a chart of each metric to its section
            "compareRunSections": sections,
            "isAccordionReordered": True,  # else MLflow sorts sections, and the one without a group is the last
        }
        self._log(run, _now(), view=state)

    def end(self, run: str, status: Status) -> None:
        self._end(run, status, _now())

    def _end(self, run: str, status: Status, when: int) -> None:
        names = utf8("\n".join(sorted(self._files.get(run, ()))))
        names = names if len(names) < _MAX_VALUE else names[:_MAX_VALUE].rpartition("\n")[0]
        self._log(run, when, tags={FILES: names} if names else {}, ended=status)

    def end_all(self, status: Status) -> None:
        """End every run that is open, children before their parent."""
        for run in self._open_runs():
            self.end(run, status)

    def _open_runs(self) -> list[str]:
        """Return the runs that are open, children before their parent."""
        return [run for run, status in reversed(self._status.items()) if status is None]

    def close(self) -> Record:
        """Wait until everything is in the store; TrackingError names what is not, and then the folder keeps its record."""
        self.end_all("KILLED")
        if not self._status:  # nothing was logged: no store is made for it
            self._remove_temporary()
            return self.record
        deadline = time.monotonic() + float(os.environ.get(PATIENCE, "15"))  # one clock for all processes of a machine
        while True:
            if self._passed_on():
                self._await_end(deadline)
            record = self.record
            if record.ended:
                break
            if time.monotonic() > deadline:
                self._fault = self._fault or "the process that writes to MLflow was killed"
                break
            time.sleep(_RETRY)
        self._record = record
        self._remove_temporary()
        if fault := self.trouble or "; ".join(record.refused):
            raise TrackingError(fault)
        if self._folder is not None:
            _remove_record(self._folder)
        return self.record

    def _remove_temporary(self) -> None:
        if self._temporary is not None:
            self._temporary.cleanup()
            self._temporary = self._folder = None

    @property
    def trouble(self) -> str | None:
        """Why nothing reaches the store at present; None if it does."""
        return self._fault or self.record.trouble

    @property
    def record(self) -> Record:
        """The runs that the store has so far, as the writer has said last."""
        if self._record is not None or self._folder is None:
            return self._record or Record()
        return read_record(self._folder)

    @property
    def seconds(self) -> float:
        """The time from the begin of the first run to the end of the last [s]."""
        return (self._ended - self._began) / 1000

    def _require(self, run: str) -> None:
        if run not in self._status:
            raise TrackingError(f"run {run!r} has not begun")

    def _log(self, run: str, when: int, **part: Any) -> None:
        """Log a part of a run."""
        self._require(run)
        part = {"run": run, "when": when} | part
        self._note(part)
        self._lines += json.dumps(part).encode() + b"\n"
        self._passed_on()

    def _note(self, part: Part) -> None:
        """Keep what a line of the journal says about its run: its status and its files."""
        run = part["run"]
        self._began = self._began or part["when"]
        self._status.setdefault(run, None)
        if "file" in part:
            self._files.setdefault(run, set()).add(f"{part['folder']}/{Path(part['file']).name}".lstrip("/"))
        if "ended" in part:
            self._status[run], self._ended = part["ended"], part["when"]

    def _passed_on(self) -> bool:
        """Append what was logged to the journal, and return whether all of it is there and has a writer."""
        try:
            with open(self.folder / JOURNAL, "ab", buffering=0) as journal:
                while self._lines:
                    self._lines = self._lines[journal.write(self._lines) :]
            if not self._has_writer():
                self._start_writer(str(self.folder))
        except OSError as error:  # a full disk, or too many processes
            self._fault = f"the journal of the runs: {error.strerror}"
            return False
        self._fault = None
        return True

    def _has_writer(self) -> bool:
        if self._process is not None:
            return self._process.poll() is None
        return self._thread is not None and self._thread.is_alive()

    def _start_writer(self, folder: str) -> None:
        arguments = self.experiment, self.uri.whole, self.study, process_tag(), folder
        if self._process is None and "mlflow" in sys.modules:
            self._writer = Writer(*arguments)
            self._thread = threading.Thread(target=self._writer.run, name="mlflow", daemon=True)
            self._thread.start()
            return
        # In a session of its own: Ctrl-C reaches the study alone, which then says what is to be written.
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SERVE.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._tell(arguments)

    def _tell(self, message: Any) -> None:
        """Send a line to the process of the writer; if it was killed, `_passed_on` starts another one."""
        assert self._process is not None
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(message).encode() + b"\n")
            self._process.stdin.flush()

    def _await_end(self, deadline: float) -> None:
        """Let the writer send the rest, and wait until it ends."""
        if self._process is not None:
            self._tell(deadline)
            self._process.wait()
        elif self._writer is not None and self._thread is not None:
            self._writer.close(deadline)
            self._thread.join()


def _remove_record(folder: Path) -> None:
    """Remove the journal of a folder, the record of its writer and the files."""
    for name in (JOURNAL, RECORD):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / _FOLDER, ignore_errors=True)


def _texts(values: Mapping[str, object]) -> dict[str, str]:
    """Return texts that every database takes, the names of files in them as UTF-8."""
    return {key: utf8(str(value)) for key, value in values.items()}


def _now() -> int:
    return int(1000 * time.time())


def _quoted(column: str) -> str:
    """Write `metrics.objective` as MLflow's UI does: metrics.`objective`."""
    kind, _, name = column.partition(".")
    return f"{kind}.`{name}`"
