"""The writer of a study's runs: it reads the journal (mlflow_tracker.py), and writes an MLflow store by MlflowClient.

`Writer.run` is the loop; `serve` runs it in a process of its own. This process ends with the study, however the study ends, and
at once: its input is at its end then. The folder of the journal has two files:

    journal.jsonl  parts of runs, one a line: run (its key), when (ms since 1970), and any of name, parent, params of a run
                   that begins; tags; metrics with their step; file (relative to the journal) with its folder in the run;
                   view; ended, a status
    record.json    a `Record`: what the store has

To write a part again changes nothing in the store. Checked in tests/tracking/test_tracker.py, test_writer.py.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from torchmbd.tracking.links import VIEW_TAG
from torchmbd.tracking.run_process import PROCESS
from torchmbd.tracking.store import all_runs, experiment_id, first_line, open_store, own_files
from torchmbd.tracking.uri import StoreURI

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

JOURNAL, RECORD = "journal.jsonl", "record.json"
_INTERVAL, _SHARE = 3.0, 0.1  # seconds between two deliveries at least; share of a core that writing takes at most
# Seconds until a store that is away is tried again, while the study computes and after it.
_RETRY, _LAST_RETRY = 5.0, 0.5
_METRICS, _WORDS = 800, 100  # in one log_batch: MLflow allows 1000 of all kinds, 100 parameters, 100 tags
# Other errors are no answer of the store.
_REFUSALS_OF_ONE = ("INVALID_PARAMETER_VALUE", "BAD_REQUEST")  # other parts of a batch may be accepted
_REFUSALS = (*_REFUSALS_OF_ONE, "RESOURCE_DOES_NOT_EXIST")

Part = dict[str, Any]  # a line of the journal


class Record(NamedTuple):
    """The runs of a study in a store, so far.

    experiment_id  in MLflow
    runs           key of a run -> its id in MLflow
    trouble        why nothing reaches the store at present, None if it does
    refused        what the store has refused
    ended          whether the writer has ended after `close`
    """

    experiment_id: str = ""
    runs: dict[str, str] = {}  # noqa: RUF012  of a tuple, which nobody changes
    trouble: str | None = None
    refused: list[str] = []  # noqa: RUF012
    ended: bool = False


def read_record(folder: Path) -> Record:
    """Return what the writer of a journal has said last."""
    try:
        return Record(*json.loads((folder / RECORD).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return Record()


def whole_lines(text: bytes) -> bytes:
    """Return a journal up to the end of its last whole line."""
    return text[: text.rfind(b"\n") + 1]


class Writer:
    """Writes the runs of one study, all in one thread.

    uri      of the store, with user and password
    study    key of the study, whose runs in the store are continued
    process  tag of the process that runs the study
    folder   of the journal
    """

    def __init__(self, experiment: str, uri: str, study: str, process: str, folder: str) -> None:
        self.experiment, self.uri, self.study, self.process = experiment, StoreURI(uri), study, process
        self.folder = Path(folder)
        self._experiment_id = ""
        self._ids: dict[str, str] = {}
        self._refused: dict[str, None] = {}
        self._position = 0  # in the journal
        self._pending: dict[str, list[Part]] = {}  # read, and not in the store yet, by run
        self._client: MlflowClient | None = None
        self._earlier: dict[str, str] | None = None  # ids of runs of an earlier process, by key; None: not read yet
        # Steps and values in the store, by run and metric.
        self._known: dict[tuple[str, str], set[tuple[int, float]]] = {}
        self._closing, self._deadline = threading.Event(), float("inf")

    def close(self, deadline: float) -> None:
        """Let `run` end when the whole journal is in the store, or at the deadline (`time.monotonic`)."""
        self._deadline = deadline
        self._closing.set()

    def run(self) -> None:
        """Bring the journal into the store until `close` is called."""
        while True:
            closing = self._closing.is_set()
            try:
                self._opened()
                began = time.thread_time()  # without the time to create the store
                self._deliver()
            except Exception as error:  # of MLflow, the database or the network: tried again
                trouble = f"the store {self.uri!r} does not take the runs: {self.uri.hide(first_line(error))}"
                ended, pause = closing and time.monotonic() > self._deadline, _RETRY
            else:
                trouble, ended = None, closing
                pause = max(_INTERVAL, (time.thread_time() - began) / _SHARE)
            self._tell(Record(self._experiment_id, self._ids, trouble, list(self._refused), ended))
            if ended:
                return
            if closing:
                time.sleep(_LAST_RETRY)
            else:
                self._closing.wait(pause)

    def _tell(self, record: Record) -> None:
        draft = self.folder / f"{RECORD}.new"
        with contextlib.suppress(OSError):  # a full disk: the study knows the record before
            draft.write_text(json.dumps(record), encoding="utf-8")
            draft.replace(self.folder / RECORD)

    def _deliver(self) -> None:
        """Write what was logged since the last call, and what could not be written then."""
        with open(self.folder / JOURNAL, "rb") as journal:
            journal.seek(self._position)
            whole = whole_lines(journal.read())  # the last line may not be complete yet
        self._position += len(whole)
        for line in whole.splitlines():
            part = json.loads(line)
            self._pending.setdefault(part["run"], []).append(part)
        while self._pending:
            run, parts = next(iter(self._pending.items()))
            self._write(run, parts)
            del self._pending[run]

    def _write(self, run: str, parts: list[Part]) -> None:
        """Write parts of a run to the store; raises if the store does not answer."""
        from mlflow.entities import Metric, Param, RunTag

        client = self._opened()
        if run not in self._ids:
            self._ids[run] = self._run_id(client, run, parts[0])
        id = self._ids[run]
        metrics = [
            Metric(key, value, part["when"], part["step"])
            for part in parts
            for key, value in part.get("metrics", {}).items()
            if not self._is_known(client, run, key, part["step"], value)
        ]
        params = [Param(*item) for part in parts for item in part.get("params", {}).items()]
        tags = [RunTag(*item) for item in {k: x for part in parts for k, x in part.get("tags", {}).items()}.items()]
        while metrics or params or tags:
            self._log(run, partial(client.log_batch, id), [metrics[:_METRICS], params[:_WORDS], tags[:_WORDS]])
            del metrics[:_METRICS], params[:_WORDS], tags[:_WORDS]
        for part in parts:
            if "file" in part:
                self._attempt(run, partial(self._upload, client, id, self.folder / part["file"], part["folder"]))
            if "view" in part:
                view = part["view"] | {"searchFilter": f'tags.mlflow.parentRunId = "{id}"'}
                client.set_experiment_tag(self._experiment_id, VIEW_TAG + id, json.dumps(view))
            if "ended" in part:
                client.set_terminated(id, part["ended"], part["when"])

    def _opened(self) -> MlflowClient:
        """Return the client; TrackingError if the store cannot be opened."""
        if self._client is None:
            client = open_store(self.uri)
            self._experiment_id = experiment_id(client, self.experiment, self.uri)
            self._client = client
        return self._client

    def _run_id(self, client: MlflowClient, run: str, begin: Part) -> str:
        """Return the id of a run, of an earlier process or newly created."""
        if self._earlier is None:
            runs = all_runs(client, [self._experiment_id], f"tags.study_key = '{self.study}'")
            self._earlier = {earlier.data.tags["run_key"]: earlier.info.run_id for earlier in runs}
        if run in self._earlier:
            client.set_tag(self._earlier[run], PROCESS, self.process)  # first: its process before was killed
            client.update_run(self._earlier[run], status="RUNNING")
            return self._earlier[run]
        tags = begin["tags"] | {"study_key": self.study, "run_key": run, PROCESS: self.process}
        if begin["parent"] is not None:
            tags["mlflow.parentRunId"] = self._ids[begin["parent"]]
        try:
            return client.create_run(self._experiment_id, begin["when"], tags, begin["name"]).info.run_id
        except Exception:
            self._earlier = None  # it may exist although the answer was lost: read again before the next attempt
            raise

    def _upload(self, client: MlflowClient, id: str, file: Path, folder: str) -> None:
        """Add a file to a run; beside a SQLite store it is copied, which needs no server."""
        target = own_files(self.uri, id)
        if target is None:
            client.log_artifact(id, str(file), folder or None)
            return
        (target / folder).mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target / folder / file.name)

    def _is_known(self, client: MlflowClient, run: str, key: str, step: int, value: float) -> bool:
        """True if an earlier process has written a metric at its step."""
        if run not in (self._earlier or {}):
            return False
        if (run, key) not in self._known:
            history = client.get_metric_history(self._ids[run], key)
            self._known[run, key] = {(stored.step, stored.value) for stored in history}
        return (step, value) in self._known[run, key]

    def _log(self, run: str, log_batch: Callable[[list, list, list], object], kinds: list[list[Any]]) -> None:
        """Log metrics, params and tags; if the store refuses them, each kind alone, then halves: one entry can hold up all."""
        from mlflow.exceptions import MlflowException

        try:
            log_batch(*kinds)
        except MlflowException as error:
            filled = [k for k, items in enumerate(kinds) if items]
            parts = [[items if k == kind else [] for k, items in enumerate(kinds)] for kind in filled]
            if len(filled) == 1:
                middle = len(kinds[filled[0]]) // 2
                parts = [[items[:middle] for items in kinds], [items[middle:] for items in kinds]] if middle else []
            if not parts or error.error_code not in _REFUSALS_OF_ONE:
                self._refuse(run, error)
                return
            for part in parts:
                self._log(run, log_batch, part)

    def _attempt(self, run: str, action: Callable[[], object]) -> None:
        """Call an action of the client; keep the message if the store answers and refuses it."""
        from mlflow.exceptions import MlflowException

        try:
            action()
        except FileNotFoundError as error:
            self._refused[f"{run}: {error.filename}: {error.strerror}"] = None
        except MlflowException as error:
            self._refuse(run, error)

    def _refuse(self, run: str, error: MlflowException) -> None:
        """Keep the message of a refusal; raise any other error."""
        if error.error_code not in _REFUSALS:
            raise error
        self._refused[f"{run}: {self.uri.hide(first_line(error))}"] = None


def serve() -> None:
    """Run a writer in this process: the arguments are the first line of standard input, the deadline at the end the second."""
    writer = Writer(*json.loads(sys.stdin.readline()))

    def listen() -> None:
        """End the process when the study ends, whatever is being written: the next writer goes on."""
        for line in sys.stdin:
            writer.close(json.loads(line))
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    writer.run()
    os._exit(0)  # Python would wait for the thread that listens
