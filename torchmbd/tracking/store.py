"""Where the runs are kept: the URI of a store, and its first opening.

    an explicit URI, else MLFLOW_TRACKING_URI, else sqlite:///<working directory>/mlflow.db with mlartifacts/ beside it

A fresh SQLite store is migrated under a file lock: two processes that create the tables at once crash (MLflow 3.17).
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from torchmbd.tracking.tracker import TrackingError

if TYPE_CHECKING:
    from mlflow import MlflowClient

SCHEMES = ("sqlite", "http", "https", "postgresql", "mysql", "mssql", "databricks")


def store_uri(uri: str | None = None) -> str:
    """Return the store to use, a relative SQLite path made absolute."""
    chosen = uri or os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{Path.cwd() / 'mlflow.db'}"
    file = sqlite_file(chosen)
    return f"sqlite:///{file}" if file else chosen


def sqlite_file(uri: str) -> Path | None:
    """Return the file of a SQLite store (absolute), or None for any other store."""
    return Path(uri.removeprefix("sqlite:///")).absolute() if uri.startswith("sqlite:///") else None


def open_store(uri: str) -> MlflowClient:
    """Open a store, creating its tables if it is new; TrackingError if it cannot be."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    logging.getLogger("mlflow").setLevel(logging.WARNING)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    from mlflow import MlflowClient  # 3 seconds: imported when a store is wanted, not before
    from mlflow.exceptions import MlflowException

    file = sqlite_file(uri)
    try:
        if file:
            file.parent.mkdir(parents=True, exist_ok=True)
        with _alone(uri):
            client = MlflowClient(uri)
            client.search_experiments(max_results=1)  # the first query creates and migrates the tables
    except (MlflowException, OSError) as error:
        raise TrackingError(f"the store {uri!r} cannot be opened: {_first_line(error)}") from error
    return client


def experiment_id(client: MlflowClient, name: str, uri: str) -> str:
    """Return the id of an experiment, creating it if it is new."""
    with _alone(uri):
        found = client.get_experiment_by_name(name)
        if found is None:
            file = sqlite_file(uri)
            return client.create_experiment(name, artifact_location=str(file.parent / "mlartifacts") if file else None)
    if found.lifecycle_stage != "active":
        raise TrackingError(f"experiment {name!r} is deleted in {uri}; restore it there or choose another name")
    return found.experiment_id


@contextmanager
def _alone(uri: str) -> Iterator[None]:
    """Hold the lock of a SQLite store, so that one process at a time creates tables and experiments."""
    if sqlite_file(uri) is None:
        yield
        return
    name = hashlib.sha256(uri.encode()).hexdigest()[:16]
    with (Path(tempfile.gettempdir()) / f"torchmbd-{os.getuid()}-{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
