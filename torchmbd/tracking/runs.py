"""What a tracker asks of a store of runs, and MLflow's client as the answer for every store.

    begin      a run opens; what is told of it from then on is collected in its Draft
    write      drafts go into the store
    artifact   a file of a run goes there
    note       a tag of the experiment
    left       the run that an earlier life of a study has left under a key
    children   run ids below a run, by their keys
    status     of a run
    probe      raises whatever the store raises if it cannot be written now

`repeatable`: the same lines of a study may be told twice, and nothing is there twice (torchmbd.tracking.sqlite_runs).
Checked in tests/tracking/test_tracker.py, tests/tracking/test_sqlite_runs.py.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from mlflow import MlflowClient

PROBE = "torchmbd.probe"
_METRICS, _WORDS = 800, 100  # in one log_batch: MLflow allows 1000 of all kinds, 100 parameters, 100 tags
_MAX_RUNS = 50_000  # children of one study


class Point(NamedTuple):
    """A metric at one step."""

    key: str
    value: float
    when: int  # ms since 1970
    step: int


@dataclass
class Draft:
    """What is told of one run and not written yet.

    name, began    of a run that is not there yet [ms since 1970]
    status, ended  how it goes on: RUNNING again, or its end [ms since 1970]
    """

    id: str
    name: str | None = None
    began: int = 0
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    metrics: list[Point] = field(default_factory=list)
    status: str | None = None
    ended: int | None = None


class Runs(Protocol):
    """See the header of this file."""

    repeatable: bool
    experiment_id: str

    def begin(self, unique: str, name: str, began: int, tags: dict[str, str]) -> Draft: ...

    def write(self, drafts: Sequence[Draft]) -> None: ...

    def artifact(self, run_id: str, file: Path, folder: str) -> None: ...

    def note(self, key: str, text: str) -> None: ...

    def left(self, study: str, run: str, root: str) -> str | None: ...

    def children(self, run_id: str) -> dict[str, str]: ...

    def status(self, run_id: str) -> str: ...

    def probe(self) -> None: ...


class ClientRuns:
    """Runs of any store, by MlflowClient: a call for each run."""

    repeatable = False

    def __init__(self, client: MlflowClient, experiment_id: str) -> None:
        self.client, self.experiment_id = client, experiment_id

    def begin(self, unique: str, name: str, began: int, tags: dict[str, str]) -> Draft:
        """Create a run at once: its id is the store's to choose, whatever is `unique` about it."""
        return Draft(self.client.create_run(self.experiment_id, began, tags=tags, run_name=name).info.run_id)

    def write(self, drafts: Sequence[Draft]) -> None:
        from mlflow.entities import Metric, Param, RunTag

        for draft in drafts:
            metrics = [Metric(*point) for point in draft.metrics]
            params = [Param(*item) for item in draft.params.items()]
            tags = [RunTag(*item) for item in draft.tags.items()]
            while metrics or params or tags:
                self.client.log_batch(draft.id, metrics[:_METRICS], params[:_WORDS], tags[:_WORDS])
                del metrics[:_METRICS], params[:_WORDS], tags[:_WORDS]
            if draft.ended is not None:
                self.client.set_terminated(draft.id, draft.status, draft.ended)
            elif draft.status is not None:
                self.client.update_run(draft.id, status=draft.status)

    def artifact(self, run_id: str, file: Path, folder: str) -> None:
        self.client.log_artifact(run_id, str(file), folder or None)

    def note(self, key: str, text: str) -> None:
        self.client.set_experiment_tag(self.experiment_id, key, text)

    def left(self, study: str, run: str, root: str) -> str | None:
        """Return `root`, if the study has left it, or else one that has not finished; None if there is neither."""
        mine = f"tags.study_key = '{study}' and tags.run_key = '{run}'"
        for condition in (f"attributes.run_id = '{root}'", "attributes.status != 'FINISHED'"):
            found = self.client.search_runs([self.experiment_id], f"{mine} and {condition}", max_results=1)
            if found:
                return found[0].info.run_id
        return None

    def children(self, run_id: str) -> dict[str, str]:
        below = f"tags.mlflow.parentRunId = '{run_id}'"
        found = self.client.search_runs([self.experiment_id], below, max_results=_MAX_RUNS)
        return {child.data.tags["run_key"]: child.info.run_id for child in found}

    def status(self, run_id: str) -> str:
        return self.client.get_run(run_id).info.status

    def probe(self) -> None:
        self.client.search_experiments(max_results=1)
        self.note(PROBE, str(time.time()))


def open_runs(uri: str, experiment: str) -> Runs:
    """Open an experiment of a store, made where it is new; TrackingError if it cannot be."""
    from torchmbd.tracking.sqlite_runs import SqliteRuns
    from torchmbd.tracking.store import experiment_id, open_store, sqlite_file

    file = sqlite_file(uri)
    if file is None:
        client = open_store(uri)
        return ClientRuns(client, experiment_id(client, experiment, uri))
    if known := SqliteRuns.of(file, experiment):
        return known
    client = open_store(uri)
    made = experiment_id(client, experiment, uri)
    return SqliteRuns.of(file, experiment) or ClientRuns(client, made)
