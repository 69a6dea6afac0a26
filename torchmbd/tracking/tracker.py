"""What every tracker says: how a run ends, where the runs are, and that the store could not be written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

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
