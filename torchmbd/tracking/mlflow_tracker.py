"""Runs in an MLflow store, by explicit run ids: no global state, many runs at once.

Runs begin and end, and metrics lie, at the time `when` they were told; a writer may be late.
What is told is collected, a Draft for each run (torchmbd.tracking.runs), and written by `flush`.

A study that died is gone on with: its root run (tags study_key and run_key; any status but FINISHED, or the very run that
the study's folder knows) and the children of it are opened again under their keys, and what they hold of metrics
(`steps`: the last step of each, and its values there, an iterate's and a result's) is not written twice.
"""

from __future__ import annotations

import copy
import json
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchmbd.tracking.links import VIEW_TAG
from torchmbd.tracking.runs import Draft, Point, open_runs
from torchmbd.tracking.store import store_uri
from torchmbd.tracking.tracker import Record, Status, TrackingError

_MAX_VALUE = 6000  # characters of a parameter; MLflow's own limit


class MlflowTracker:
    """Keeps the contract of torchmbd.tracking.tracker here and now."""

    def __init__(
        self,
        experiment: str,
        uri: str | None = None,
        study: str | None = None,
        runs: Mapping[str, str] | None = None,
        steps: Mapping[str, Mapping[str, list[Any]]] | None = None,
        earlier: str = "",
        life: str = "",
    ) -> None:
        """`runs`, `steps`: what an earlier writer of this study has written, by the key of the run.

        earlier   run id of the root of an earlier life that has not told its end, if it is known
        life      one life of the study, the same for all its writers; default: a life of its own
        """
        self.uri = store_uri(uri)
        self.store = open_runs(self.uri, experiment)
        self.experiment_id = self.store.experiment_id
        self.study, self._life = study, f"{study} {life or uuid.uuid4().hex}"
        self.when: int | None = None  # what is told now has happened [ms since 1970]; None: now
        self.runs: dict[str, str] = dict(runs or {})
        self.steps = {run: dict(last) for run, last in (steps or {}).items()}
        self._written = copy.deepcopy(self.steps)
        self._open = [run for run, id in self.runs.items() if self.store.status(id) == "RUNNING"]
        self._root = earlier
        self._earlier: dict[str, str] | None = None  # run ids of an earlier life of the study
        self._drafts: dict[str, Draft] = {}

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        if run in self.runs:
            raise TrackingError(f"run {run!r} has begun already")
        everything = dict(tags or {})
        if self.study is not None:
            everything |= {"study_key": self.study, "run_key": run}
        if parent is not None:
            everything["mlflow.parentRunId"] = self._id(parent)
        earlier = self._found(run, parent)
        if earlier is None:
            draft = self.store.begin(f"{self._life} {run}", name, self._now(), everything)
            self.steps.pop(run, None)
            self._written.pop(run, None)
        else:
            draft = Draft(earlier, status="RUNNING")
        self._drafts[run], self.runs[run] = draft, draft.id
        self._open.append(run)
        draft.params |= {key: str(value)[:_MAX_VALUE] for key, value in (params or {}).items()}

    def _found(self, run: str, parent: str | None) -> str | None:
        """Return the id of a run of an earlier life of this study, None if there is none to go on with."""
        if self.study is None:
            return None
        if parent is None:
            root = self.store.left(self.study, run, self._root)
            self._earlier = {run: root} if root else {}
        elif self._earlier is None or parent not in self._earlier:
            return None
        elif len(self._earlier) == 1:
            self._earlier |= self.store.children(self._earlier[parent])
        return (self._earlier or {}).get(run)

    def metrics(self, run: str, values: Mapping[str, float], step: int = 0) -> None:
        draft, now = self._draft(run), self._now()
        written, last = self._written.get(run, {}), self.steps.setdefault(run, {})
        for key, value in values.items():
            known, there = written.get(key, (-1, ()))
            if step < known or (step == known and float(value) in there):
                continue
            latest = last.get(key, [-1, []])
            latest = latest if step == latest[0] else [step, []]
            # The later of two at one step is the last one, also where both were told within a millisecond.
            draft.metrics.append(Point(key, float(value), now + len(latest[1]), step))
            latest[1].append(float(value))
            if step >= last.get(key, [-1])[0]:
                last[key] = latest

    def tags(self, run: str, values: Mapping[str, str]) -> None:
        self._draft(run).tags.update({key: str(value) for key, value in values.items()})

    def artifact(self, run: str, file: str | Path, folder: str = "") -> None:
        self.store.artifact(self._id(run), Path(file), folder)

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
        self.store.note(VIEW_TAG + self._id(run), json.dumps(state))

    def end(self, run: str, status: Status) -> None:
        draft = self._draft(run)
        draft.status, draft.ended = status, self._now()
        if run in self._open:
            self._open.remove(run)

    def flush(self, *runs: str) -> None:
        """Write what waits: of some runs, or of all."""
        chosen = runs or self.waiting
        self.store.write([self._drafts[run] for run in chosen])
        self.forget(*chosen)

    def forget(self, *runs: str) -> None:
        """Drop what waits of some runs."""
        for run in runs:
            self._drafts.pop(run, None)

    @property
    def waiting(self) -> tuple[str, ...]:
        """Runs of which something is not written yet."""
        return tuple(self._drafts)

    def close(self) -> Record:
        for run in reversed(list(self._open)):  # children before their parent
            self.end(run, "KILLED")
        self.flush()
        return self.record()

    def record(self) -> Record:
        """Return where the runs are."""
        return Record(self.uri, self.experiment_id, dict(self.runs))

    @property
    def finished(self) -> bool:
        """Whether no run of this study is left to go on with."""
        return not self._open and all(self.store.status(run) == "FINISHED" for run in list(self.runs.values())[:1])

    def _now(self) -> int:
        return int(1000 * time.time()) if self.when is None else self.when

    def _draft(self, run: str) -> Draft:
        return self._drafts.setdefault(run, Draft(self._id(run)))

    def _id(self, run: str) -> str:
        if run not in self.runs:
            raise TrackingError(f"run {run!r} has not begun")
        return self.runs[run]


def _quoted(column: str) -> str:
    """Write `metrics.objective` as MLflow's UI does: metrics.`objective`."""
    kind, _, name = column.partition(".")
    return f"{kind}.`{name}`"
