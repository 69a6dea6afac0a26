"""Runs in an MLflow store, by MlflowClient and explicit run ids: no global state, many runs at once.

Metrics are collected and written by log_batch, all steps of a run in one call: at `flush`, before anything else
is written to the run, and at `end`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchmbd.tracking.links import VIEW_TAG
from torchmbd.tracking.store import experiment_id, open_store, store_uri
from torchmbd.tracking.tracker import Record, Status, TrackingError

_MAX_BATCH = 1000  # metrics in one log_batch; MLflow's own limit
_MAX_VALUE = 6000  # characters of a parameter; MLflow's own limit


class MlflowTracker:
    """Keeps the contract of torchmbd.tracking.tracker here and now."""

    def __init__(self, experiment: str, uri: str | None = None) -> None:
        self.uri = store_uri(uri)
        self.client = open_store(self.uri)
        self.experiment_id = experiment_id(self.client, experiment, self.uri)
        self._runs: dict[str, str] = {}
        self._open: list[str] = []
        self._waiting: dict[str, list[Any]] = {}

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        from mlflow.entities import Param

        if run in self._runs:
            raise TrackingError(f"run {run!r} has begun already")
        everything = dict(tags or {})
        if parent is not None:
            everything["mlflow.parentRunId"] = self._id(parent)
        created = self.client.create_run(self.experiment_id, tags=everything, run_name=name)
        self._runs[run] = created.info.run_id
        self._open.append(run)
        if params:
            texts = [Param(key, str(value)[:_MAX_VALUE]) for key, value in params.items()]
            self.client.log_batch(self._runs[run], params=texts)

    def metrics(self, run: str, values: Mapping[str, float], step: int = 0) -> None:
        from mlflow.entities import Metric

        self._id(run)
        now = int(time.time() * 1000)
        batch = self._waiting.setdefault(run, [])
        batch.extend(Metric(key, float(value), now, step) for key, value in values.items())

    def tags(self, run: str, values: Mapping[str, str]) -> None:
        from mlflow.entities import RunTag

        self.client.log_batch(self._id(run), tags=[RunTag(key, str(value)) for key, value in values.items()])

    def artifact(self, run: str, file: str | Path, folder: str = "") -> None:
        self.client.log_artifact(self._id(run), str(file), folder or None)

    def view(self, run: str, columns: Sequence[str], order_by: str) -> None:
        """Store a view of the run's children that `links.view_link` opens.

        columns, order_by   `metrics.objective`, `params.start`, `tags.status`
        """
        state = {
            "searchFilter": f'tags.mlflow.parentRunId = "{self._id(run)}"',
            "orderByKey": _quoted(order_by),
            "orderByAsc": True,
            "startTime": "ALL",
            "lifecycleFilter": "Active",
            "selectedColumns": [_quoted(column) for column in columns],
            "runsHiddenMode": "SHOW_ALL",
        }
        self.client.set_experiment_tag(self.experiment_id, VIEW_TAG + self._id(run), json.dumps(state))

    def end(self, run: str, status: Status) -> None:
        self.flush()
        self.client.set_terminated(self._id(run), status)
        self._open.remove(run)

    def flush(self) -> None:
        """Write the metrics that wait."""
        waiting, self._waiting = self._waiting, {}
        for run, batch in waiting.items():
            for first in range(0, len(batch), _MAX_BATCH):
                self.client.log_batch(self._runs[run], metrics=batch[first : first + _MAX_BATCH])

    def close(self) -> Record:
        for run in reversed(list(self._open)):  # children before their parent
            self.end(run, "KILLED")
        return Record(self.uri, self.experiment_id, dict(self._runs))

    def _id(self, run: str) -> str:
        if run not in self._runs:
            raise TrackingError(f"run {run!r} has not begun")
        return self._runs[run]


def _quoted(column: str) -> str:
    """Write `metrics.objective` as MLflow's UI does: metrics.`objective`."""
    kind, _, name = column.partition(".")
    return f"{kind}.`{name}`"
