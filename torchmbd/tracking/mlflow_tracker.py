"""Runs in an MLflow store, written in the background: a study waits for the store only at its end.

    study                                 thread                  process (store_process.py)
    metrics("start_3", {...}, 7)    ->    every few seconds  ->   MlflowClient.log_batch of what was logged of each run
    close()                         ->    the rest; then the Record

    begin    open a run under a key ("study", "start_3"), perhaps as the child of another
    metrics  log numbers of one step (an iteration)
    tags     log words
    artifact log a file
    view     define the table of the children: metrics, parameters and tags
    end      end a run: FINISHED, FAILED or KILLED
    close    end open runs as KILLED, wait for the store, return where the runs are

Times are those of logging. To send the same again changes nothing in the store, so whatever fails is sent again, until the
store answers, or until `TORCHMBD_PATIENCE` seconds (default 15) after the end of the study. What the store refuses (a file
that does not exist) is named by `close`; everything else is sent.

`study` is the same for all processes that run a study: one that continues a killed study finds its runs by the tags study_key
and run_key, and writes no metric twice. Runs of a process that was killed are ended by whoever reads the store next
(run_process.py). Checked in tests/tracking/test_tracker.py.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchmbd.process import utf8
from torchmbd.tracking.run_process import process_tag
from torchmbd.tracking.store import first_line, store_uri
from torchmbd.tracking.store_process import StoreProcess
from torchmbd.tracking.study_store import PendingRun, Point, StudyStore
from torchmbd.tracking.tracker import Record, Status, TrackingError
from torchmbd.tracking.uri import StoreURI

FILES = "files"  # tag of a run that is over: the names of its files, one a line
PATIENCE = "TORCHMBD_PATIENCE"  # environment variable: seconds to wait for a store that is away when the study is over
_INTERVAL, _SHARE = 3.0, 0.1  # seconds between two deliveries at least; share of a core that writing takes at most
# Seconds until a store that is away is tried again, while the study computes and after it.
_RETRY, _LAST_RETRY = (
    5.0,
    0.5,
)
_MAX_VALUE = 6000  # characters of a parameter; MLflow's own limit
_UNGROUPED = "Model metrics"  # section of charts of metrics without a group, by MLflow


class MlflowTracker:
    """Logs the runs of a study, see the header of this file.

    study  key of the study, whose runs are continued; None: a new study
    """

    def __init__(self, experiment: str, uri: str | StoreURI | None = None, study: str | None = None) -> None:
        self.experiment, self.uri = experiment, store_uri(uri)
        self.study = study or uuid.uuid4().hex
        self.trouble: str | None = None  # why nothing reaches the store at present
        self._lock = threading.Lock()
        self._pending: dict[str, PendingRun] = {}  # logged since the last delivery, by the key of the run
        self._open: dict[str, bool] = {}  # every run that has begun: whether it is open
        self._files: dict[str, set[str]] = {}  # names of the files of every run
        self._last = 0  # ms since 1970 of the last metric
        self._store = self._new_store()
        self._closing, self._deadline = threading.Event(), float("inf")
        self._thread = threading.Thread(target=self._deliver, name="mlflow", daemon=True)

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        if run in self._open:
            raise TrackingError(f"run {run!r} has begun already")
        if parent is not None:
            self._require(parent)
        with self._lock:
            texts = {key: value[:_MAX_VALUE] for key, value in _texts(params or {}).items()}
            self._pending[run] = PendingRun(utf8(name), _now(), parent, texts, _texts(tags or {}))
        self._open[run] = True
        if self._thread.ident is None:
            self._thread.start()

    def metrics(self, run: str, values: Mapping[str, float], step: int = 0) -> None:
        self._last = max(_now(), self._last + 1)  # the later of two at one step is the last one
        with self._lock:
            points = self._draft(run).metrics
            points += [Point(key, float(value), self._last, step) for key, value in values.items()]

    def tags(self, run: str, values: Mapping[str, str]) -> None:
        with self._lock:
            self._draft(run).tags.update(_texts(values))

    def artifact(self, run: str, file: str | Path, folder: str = "") -> None:
        """Log a file, which must exist until `close` has returned."""
        with self._lock:
            self._draft(run).artifacts.append((Path(file).absolute(), folder))
            self._files.setdefault(run, set()).add(f"{folder}/{Path(file).name}".lstrip("/"))

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
        with self._lock:
            self._draft(run).view = json.dumps(state)

    def end(self, run: str, status: Status) -> None:
        with self._lock:
            draft = self._draft(run)
            draft.ended = status, _now()
            if names := utf8("\n".join(sorted(self._files.get(run, ())))):
                draft.tags[FILES] = names if len(names) < _MAX_VALUE else names[:_MAX_VALUE].rpartition("\n")[0]
        self._open[run] = False

    def close(self) -> Record:
        """Wait until everything is in the store; TrackingError names what is not."""
        for run in reversed([run for run, is_open in self._open.items() if is_open]):  # children before their parent
            self.end(run, "KILLED")
        if self._thread.ident is None:  # nothing was logged: no store is made for it
            return self.record
        self._deadline = time.monotonic() + float(os.environ.get(PATIENCE, "15"))
        self._closing.set()
        self._thread.join()
        self._store.close()
        if self.trouble:
            raise TrackingError(self.trouble)
        if self._store.refused:
            raise TrackingError("; ".join(self._store.refused))
        return self.record

    @property
    def record(self) -> Record:
        """The runs that the store has so far."""
        return Record(self.uri, self._store.experiment_id, dict(self._store.ids))

    def _new_store(self) -> StudyStore | StoreProcess:
        """The store in this process where MLflow is imported already, else in one that takes no time of the search."""
        if "mlflow" in sys.modules:
            return StudyStore(self.experiment, self.uri, self.study, process_tag())
        return StoreProcess(self.experiment, self.uri, self.study)

    def _require(self, run: str) -> None:
        if run not in self._open:
            raise TrackingError(f"run {run!r} has not begun")

    def _draft(self, run: str) -> PendingRun:
        self._require(run)
        return self._pending.setdefault(run, PendingRun())

    def _take_pending(self) -> deque[tuple[str, PendingRun]]:
        """Return what was logged since the last call, by run."""
        with self._lock:
            pending, self._pending = self._pending, {}
        return deque(pending.items())

    def _deliver(self) -> None:
        """Write pending runs to the store until the tracker is closed: the loop of the thread."""
        pending: deque[tuple[str, PendingRun]] = deque()
        while True:
            closing = self._closing.is_set()
            pending = pending or self._take_pending()
            try:
                self._store.opened()
                began = self._store.processor_time()  # without the time to create the store
                while pending:
                    self._store.write(*pending[0])
                    pending.popleft()
                    if closing and not pending:
                        pending = self._take_pending()
            except Exception as error:  # of MLflow, the database or the network: tried again
                self.trouble = f"the store {self.uri!r} does not take the runs: {self.uri.hide(first_line(error))}"
                if closing and time.monotonic() > self._deadline:
                    return
                pause = _RETRY
            else:
                self.trouble = None
                if closing:
                    return
                pause = max(_INTERVAL, (self._store.processor_time() - began) / _SHARE)
            if closing:
                time.sleep(_LAST_RETRY)
            else:
                self._closing.wait(pause)


def _texts(values: Mapping[str, object]) -> dict[str, str]:
    """Return texts that every database takes, the names of files in them as UTF-8."""
    return {key: utf8(str(value)) for key, value in values.items()}


def _now() -> int:
    return int(1000 * time.time())


def _quoted(column: str) -> str:
    """Write `metrics.objective` as MLflow's UI does: metrics.`objective`."""
    kind, _, name = column.partition(".")
    return f"{kind}.`{name}`"
