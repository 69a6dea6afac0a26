"""Write the runs of a study to an MLflow store by MlflowClient, for mlflow_tracker.py, here or in store_process.py.

To write the same again changes nothing in the store. Checked in tests/tracking/test_tracker.py.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from torchmbd.tracking.links import VIEW_TAG
from torchmbd.tracking.run_process import PROCESS
from torchmbd.tracking.store import all_runs, experiment_id, first_line, open_store, own_files
from torchmbd.tracking.tracker import Status
from torchmbd.tracking.uri import StoreURI

if TYPE_CHECKING:
    from mlflow import MlflowClient

_METRICS, _WORDS = 800, 100  # in one log_batch: MLflow allows 1000 of all kinds, 100 parameters, 100 tags
# Other errors: no answer of the store.
_REFUSALS = (
    "INVALID_PARAMETER_VALUE",
    "RESOURCE_DOES_NOT_EXIST",
    "BAD_REQUEST",
)


class Point(NamedTuple):
    """A metric at one step."""

    key: str
    value: float
    when: int  # ms since 1970
    step: int


@dataclass
class PendingRun:
    """The part of a run that was logged and is not in the store yet."""

    name: str | None = None  # of a run that begins
    began: int = 0  # ms since 1970
    parent: str | None = None  # key of the run above it
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    metrics: list[Point] = field(default_factory=list)
    artifacts: list[tuple[Path, str]] = field(default_factory=list)  # files and their folders in the run
    view: str | None = None
    ended: tuple[Status, int] | None = None  # ms since 1970


class StudyStore:
    """One study in the store, by MlflowClient; all of it in one thread.

    process  tag of the process that runs the study
    """

    def __init__(self, experiment: str, uri: StoreURI, study: str, process: str) -> None:
        self.experiment, self.uri, self.study, self.process = experiment, uri, study, process
        self.experiment_id = ""
        self.ids: dict[str, str] = {}  # of the runs, by their keys
        self.refused: list[str] = []
        self._client: MlflowClient | None = None
        self._earlier: dict[str, str] | None = None  # ids of runs of an earlier process, by key; None: not read yet
        self._known: dict[
            tuple[str, str], set[tuple[int, float]]
        ] = {}  # steps and values in the store, by run and metric

    def write(self, run: str, draft: PendingRun) -> None:
        """Write a draft of a run to the store; raises if the store does not answer."""
        from mlflow.entities import Metric, Param, RunTag

        client = self.opened()
        if run not in self.ids:
            self.ids[run] = self._run_id(client, run, draft)
        id = self.ids[run]
        metrics = [Metric(*point) for point in draft.metrics if not self._is_known(client, run, point)]
        params = [Param(*item) for item in draft.params.items()]
        tags = [RunTag(*item) for item in draft.tags.items()]
        while metrics or params or tags:
            self._attempt(run, partial(client.log_batch, id, metrics[:_METRICS], params[:_WORDS], tags[:_WORDS]))
            del metrics[:_METRICS], params[:_WORDS], tags[:_WORDS]
        for file, folder in draft.artifacts:
            self._attempt(run, partial(self._upload, client, id, file, folder))
        if draft.view is not None:
            view = json.loads(draft.view) | {"searchFilter": f'tags.mlflow.parentRunId = "{id}"'}
            client.set_experiment_tag(self.experiment_id, VIEW_TAG + id, json.dumps(view))
        if draft.ended is not None:
            client.set_terminated(id, *draft.ended)

    def processor_time(self) -> float:
        """Processor time of the thread that writes [s]."""
        return time.thread_time()

    def close(self) -> None:
        """Nothing is left to end."""

    def opened(self) -> MlflowClient:
        """Return the client; TrackingError if the store cannot be opened."""
        if self._client is None:
            client = open_store(self.uri)
            self.experiment_id = experiment_id(client, self.experiment, self.uri)
            self._client = client
        return self._client

    def _run_id(self, client: MlflowClient, run: str, draft: PendingRun) -> str:
        """Return the id of a run, of an earlier process or newly created."""
        if self._earlier is None:
            runs = all_runs(client, [self.experiment_id], f"tags.study_key = '{self.study}'")
            self._earlier = {earlier.data.tags["run_key"]: earlier.info.run_id for earlier in runs}
        if run in self._earlier:
            client.set_tag(self._earlier[run], PROCESS, self.process)  # first: its process before was killed
            client.update_run(self._earlier[run], status="RUNNING")
            return self._earlier[run]
        tags = draft.tags | {"study_key": self.study, "run_key": run, PROCESS: self.process}
        if draft.parent is not None:
            tags["mlflow.parentRunId"] = self.ids[draft.parent]
        try:
            return client.create_run(self.experiment_id, draft.began, tags, draft.name).info.run_id
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

    def _is_known(self, client: MlflowClient, run: str, point: Point) -> bool:
        """True if an earlier process has written a metric at its step."""
        if run not in (self._earlier or {}):
            return False
        if (run, point.key) not in self._known:
            history = client.get_metric_history(self.ids[run], point.key)
            self._known[run, point.key] = {(stored.step, stored.value) for stored in history}
        return (point.step, point.value) in self._known[run, point.key]

    def _attempt(self, run: str, action: Callable[[], object]) -> None:
        """Call an action of the client; keep the message if the store answers and refuses it."""
        from mlflow.exceptions import MlflowException

        try:
            action()
        except FileNotFoundError as error:
            self.refused.append(f"{run}: {error.filename}: {error.strerror}")
        except MlflowException as error:
            if error.error_code not in _REFUSALS:
                raise
            self.refused.append(f"{run}: {self.uri.hide(first_line(error))}")
