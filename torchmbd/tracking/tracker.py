"""Status and record of tracked runs, and the error of a store that cannot be written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from torchmbd.errors import MbdError
from torchmbd.tracking.uri import StoreURI

Status = Literal["FINISHED", "FAILED", "KILLED"]


class TrackingError(MbdError):
    """The store could not be opened or written."""


@dataclass(frozen=True)
class Record:
    """The runs of a study in a store: URI, id of the experiment, and the run id of each key."""

    uri: StoreURI
    experiment_id: str
    runs: dict[str, str] = field(default_factory=dict)
