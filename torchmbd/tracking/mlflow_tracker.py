"""Runs in an MLflow store, by MlflowClient and explicit run ids: no global state, many runs at once.

Runs begin and end, and metrics lie, at the time `when` they were told; a writer may be late.
Metrics and tags are collected and written by log_batch, all of a run in one call: at `flush` and at `end`.

A study that died is gone on with: its root run (tags study_key and run_key; any status but FINISHED, or the very run that
the study's folder knows) and the children of it are opened again under their keys, and what they hold of metrics
(`steps`) is not written twice.
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

_MAX_BATCH = 900  # metrics in one log_batch: 1000 of all kinds is MLflow's own limit, 100 of tags
_MAX_RUNS = 50_000  # children of one study
_MAX_VALUE = 6000  # characters of a parameter; MLflow's own limit


class MlflowTracker:
    """Keeps the contract of torchmbd.tracking.tracker here and now."""

    def __init__(
        self,
        experiment: str,
        uri: str | None = None,
        study: str | None = None,
        runs: Mapping[str, str] | None = None,
        steps: Mapping[str, Mapping[str, int]] | None = None,
        earlier: str = "",
    ) -> None:
        """`runs`, `steps`: what an earlier writer of this study has written, by the key of the run.

        earlier   run id of the root of an earlier life that has not told its end, if it is known
        """
        self.uri = store_uri(uri)
        self.client = open_store(self.uri)
        self.experiment_id = experiment_id(self.client, experiment, self.uri)
        self.study = study
        self.when: int | None = None  # what is told now has happened [ms since 1970]; None: now
        self.runs: dict[str, str] = dict(runs or {})
        self.steps = {run: dict(last) for run, last in (steps or {}).items()}
        self._written = {run: dict(last) for run, last in self.steps.items()}
        self._open = [run for run, id in self.runs.items() if self._running(id)]
        self._root = earlier
        self._earlier: dict[str, str] | None = None  # run ids of an earlier life of the study
        self._waiting: dict[str, list[Any]] = {}  # metrics
        self._words: dict[str, dict[str, str]] = {}  # tags

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        from mlflow.entities import Param

        if run in self.runs:
            raise TrackingError(f"run {run!r} has begun already")
        everything = dict(tags or {})
        if self.study is not None:
            everything |= {"study_key": self.study, "run_key": run}
        if parent is not None:
            everything["mlflow.parentRunId"] = self._id(parent)
        earlier = self._found(run, parent)
        if earlier is None:
            began = self.client.create_run(self.experiment_id, self._now(), tags=everything, run_name=name)
            self.runs[run] = began.info.run_id
            self.steps.pop(run, None)
            self._written.pop(run, None)
        else:
            self.runs[run] = earlier
            self.client.update_run(earlier, status="RUNNING")
        self._open.append(run)
        if params:
            texts = [Param(key, str(value)[:_MAX_VALUE]) for key, value in params.items()]
            self.client.log_batch(self.runs[run], params=texts)

    def _found(self, run: str, parent: str | None) -> str | None:
        """Return the id of a run of an earlier life of this study, None if there is none to go on with."""
        if self.study is None:
            return None
        if parent is None:
            root = self._left(run, f"attributes.run_id = '{self._root}'")
            root = root or self._left(run, "attributes.status != 'FINISHED'")
            self._earlier = {run: root} if root else {}
        elif self._earlier is None or parent not in self._earlier:
            return None
        elif len(self._earlier) == 1:
            below = f"tags.mlflow.parentRunId = '{self._earlier[parent]}'"
            found = self.client.search_runs([self.experiment_id], below, max_results=_MAX_RUNS)
            self._earlier |= {child.data.tags["run_key"]: child.info.run_id for child in found}
        return (self._earlier or {}).get(run)

    def _left(self, run: str, condition: str) -> str | None:
        """Return the id of a run that this study has left under a key, None if none meets the condition."""
        mine = f"tags.study_key = '{self.study}' and tags.run_key = '{run}' and {condition}"
        found = self.client.search_runs([self.experiment_id], mine, max_results=1)
        return found[0].info.run_id if found else None

    def metrics(self, run: str, values: Mapping[str, float], step: int = 0) -> None:
        from mlflow.entities import Metric

        self._id(run)
        now = self._now()
        batch, written, last = (
            self._waiting.setdefault(run, []),
            self._written.get(run, {}),
            self.steps.setdefault(run, {}),
        )
        for key, value in values.items():
            if step > written.get(key, -1):
                batch.append(Metric(key, float(value), now, step))
                last[key] = max(step, last.get(key, -1))

    def tags(self, run: str, values: Mapping[str, str]) -> None:
        self._id(run)
        self._words.setdefault(run, {}).update({key: str(value) for key, value in values.items()})

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
        self.flush(run)
        self.client.set_terminated(self._id(run), status, self._now())
        if run in self._open:
            self._open.remove(run)

    def flush(self, *runs: str) -> None:
        """Write the metrics and tags that wait: of some runs, or of all."""
        from mlflow.entities import RunTag

        for run in runs or dict.fromkeys([*self._waiting, *self._words]):
            batch, words = self._waiting.get(run, []), self._words.get(run, {})
            while batch or words:
                tags = [RunTag(key, value) for key, value in words.items()]
                self.client.log_batch(self.runs[run], metrics=batch[:_MAX_BATCH], tags=tags)
                del batch[:_MAX_BATCH]
                words.clear()
            self.forget(run)

    def forget(self, *runs: str) -> None:
        """Drop the metrics and tags that wait: of some runs, or of all."""
        for run in runs or dict.fromkeys([*self._waiting, *self._words]):
            self._waiting.pop(run, None)
            self._words.pop(run, None)

    def probe(self) -> None:
        """Raise whatever the store raises if it cannot be read and written now."""
        self.client.search_experiments(max_results=1)
        self.client.set_experiment_tag(self.experiment_id, "torchmbd.probe", str(time.time()))

    def close(self) -> Record:
        self.flush()
        for run in reversed(list(self._open)):  # children before their parent
            self.end(run, "KILLED")
        return self.record()

    def record(self) -> Record:
        """Return where the runs are."""
        return Record(self.uri, self.experiment_id, dict(self.runs))

    @property
    def finished(self) -> bool:
        """Whether no run of this study is left to go on with."""
        return not self._open and all(self._status(run) == "FINISHED" for run in list(self.runs.values())[:1])

    def _now(self) -> int:
        return int(1000 * time.time()) if self.when is None else self.when

    def _status(self, run_id: str) -> str:
        return self.client.get_run(run_id).info.status

    def _running(self, run_id: str) -> bool:
        return self._status(run_id) == "RUNNING"

    def _id(self, run: str) -> str:
        if run not in self.runs:
            raise TrackingError(f"run {run!r} has not begun")
        return self.runs[run]


def _quoted(column: str) -> str:
    """Write `metrics.objective` as MLflow's UI does: metrics.`objective`."""
    kind, _, name = column.partition(".")
    return f"{kind}.`{name}`"
