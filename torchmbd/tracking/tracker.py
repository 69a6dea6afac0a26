"""The contract of tracking: a study and its starts are runs; what happens to a run is told once, one way.

    begin    a run opens, under a key that the caller chooses ("study", "start_3"), perhaps below a parent
    metrics  numbers of one step of it (an iteration)
    tags     words about it
    artifact a file of it
    view     which metrics, parameters and tags of its children show best how they compare
    end      it is over: FINISHED, FAILED or KILLED
    close    nothing more will come: what is still open is KILLED; returns where the runs are

No call returns anything before `close`, so that a tracker may write in batches, in another thread.
A tracker that cannot write raises TrackingError, at the latest in `close`.
Kept by MlflowTracker; tests/tracking/test_tracker.py runs it against a real store.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from torchmbd.errors import MbdError

Status = Literal["FINISHED", "FAILED", "KILLED"]


class TrackingError(MbdError):
    """The store could not be opened or written."""


@dataclass(frozen=True)
class Record:
    """Where the runs are: the store, the experiment's id there, and the run id of every key."""

    uri: str
    experiment_id: str
    runs: dict[str, str] = field(default_factory=dict)


class Tracker(Protocol):
    """See the header of this file."""

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None: ...

    def metrics(self, run: str, values: Mapping[str, float], step: int = 0) -> None: ...

    def tags(self, run: str, values: Mapping[str, str]) -> None: ...

    def artifact(self, run: str, file: str | Path, folder: str = "") -> None: ...

    def view(self, run: str, columns: Sequence[str], order_by: str) -> None: ...

    def end(self, run: str, status: Status) -> None: ...

    def close(self) -> Record: ...
