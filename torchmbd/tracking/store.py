"""MLflow stores: their URI, and how a new one is created.

    an explicit URI, else MLFLOW_TRACKING_URI, else sqlite:///<working directory>/mlflow.db with mlartifacts/ beside it

The files of the runs of a SQLite store are beside it, in mlartifacts/<run id>/artifacts/. The store refers to them by
`mlflow-artifacts:/`, where the server of `torchmbd ui` (or `mlflow server`, started in that folder) finds them: it holds no
absolute path, so that both can be copied.

A new SQLite store is created under a lock (a file in the user's cache), since two processes that create its tables at once
crash (MLflow 3.17), and under another name first: a full disk or a kill leaves no incomplete store.
"""

from __future__ import annotations

import fcntl
import logging
import os
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from torchmbd.errors import InputError
from torchmbd.process import require_cache_folder
from torchmbd.tracking.tracker import TrackingError

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

_PAGE = 1000  # runs of one query
ARTIFACTS = "mlflow-artifacts:/"  # MLflow's URI of the files of its server
_MISREAD = ("?", "%")  # characters of a path that MLflow misreads: the first ends a path, the second is decoded
SCHEMES = ("sqlite", "http", "https", "postgresql", "mysql", "mssql", "databricks")
_SETTINGS = {  # of MLflow
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",  # a missing server is reported within seconds, not minutes
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
}


def store_uri(uri: str | None = None) -> str:
    """Return the URI of the store to use, a SQLite path made absolute; InputError if it is no URI of a store."""
    given = "uri" if uri else "MLFLOW_TRACKING_URI" if os.environ.get("MLFLOW_TRACKING_URI") else "the store"
    chosen = uri or os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{Path.cwd() / 'mlflow.db'}"
    if not isinstance(chosen, str):
        raise InputError(f"uri is {chosen!r}; allowed: a store such as sqlite:///mlflow.db")
    if fault := uri_fault(chosen):
        raise InputError(f"{given} = {chosen!r}: {fault}")
    file = sqlite_file(chosen)
    return f"sqlite:///{file}" if file else chosen


def uri_fault(uri: str) -> str | None:
    """Return why a URI is no store, None if it may be one."""
    scheme, separator, _ = uri.partition(":")
    if not separator or scheme.partition("+")[0] not in SCHEMES:
        return f"a store is one of {', '.join(f'{name}:' for name in SCHEMES)}; allowed: such as sqlite:///mlflow.db"
    file = sqlite_file(uri)
    if file and any(c in str(file) for c in _MISREAD):
        return (
            f"MLflow misreads {' and '.join(_MISREAD)} in a path; allowed: a path without, named by MLFLOW_TRACKING_URI"
        )
    return None


def sqlite_file(uri: str) -> Path | None:
    """Return the file of a SQLite store (absolute), or None for any other store."""
    return Path(uri.removeprefix("sqlite:///")).absolute() if uri.startswith("sqlite:///") else None


def own_files(uri: str, run_id: str) -> Path | None:
    """Return the folder of a run's files beside a SQLite store (absolute), whether it exists or not; None for others."""
    file = sqlite_file(uri)
    return None if file is None else file.parent / "mlartifacts" / run_id / "artifacts"


def relative_to_store(uri: str, file: Path) -> str:
    """Return a path relative to the folder of a SQLite store; for other stores, to the working directory."""
    store = sqlite_file(uri)
    return os.path.relpath(file, Path.cwd() if store is None else store.parent)


def open_store(uri: str) -> MlflowClient:
    """Open a store, creating its tables if it is new; TrackingError if it cannot be opened."""
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    logging.getLogger("urllib3").setLevel(logging.ERROR)  # its retries; how they end is reported
    from mlflow import MlflowClient  # takes 3 seconds
    from mlflow.exceptions import MlflowException

    file = sqlite_file(uri)
    try:
        with _store_lock(uri):
            if file:
                _require_file(file)
            client = MlflowClient(uri)
            client.search_experiments(max_results=1)
    except (MlflowException, OSError, sqlite3.Error) as error:
        raise TrackingError(f"the store {uri!r} cannot be opened: {first_line(error)}") from error
    return client


def _require_file(file: Path) -> None:
    """Create a SQLite store that does not exist; one with some of its tables could not be completed later."""
    from mlflow import MlflowClient

    file.parent.mkdir(parents=True, exist_ok=True)
    if file.exists():
        with closing(sqlite3.connect(file)) as base:  # MLflow would try for minutes to open a file that is no store
            base.execute("pragma user_version")
        return
    with tempfile.TemporaryDirectory(prefix=f".{file.name}-", dir=file.parent) as folder:
        draft = Path(folder) / file.name
        MlflowClient(f"sqlite:///{draft}").search_experiments(max_results=1)  # the first query makes the tables
        with closing(sqlite3.connect(draft)) as base:  # MLflow's experiment "Default" is in the working directory
            base.execute("update experiments set artifact_location = ? || experiment_id", (ARTIFACTS,))
            base.commit()
        draft.replace(file)


def experiment_id(client: MlflowClient, name: str, uri: str) -> str:
    """Return the id of an experiment, creating it if it is new."""
    with _store_lock(uri):
        found = client.get_experiment_by_name(name)
        if found is None:
            return client.create_experiment(name, artifact_location=ARTIFACTS if sqlite_file(uri) else None)
    if found.lifecycle_stage != "active":
        raise TrackingError(f"experiment {name!r} is deleted in {uri}; restore it there or choose another name")
    return found.experiment_id


def all_runs(client: MlflowClient, experiments: list[str], condition: str, order: list[str] | None = None) -> list[Run]:
    """Return every run of some experiments (ids) that a filter of MLflow finds, page by page."""
    runs: list[Run] = []
    token = None
    while True:
        page = client.search_runs(experiments, condition, max_results=_PAGE, order_by=order, page_token=token)
        runs += page
        token = page.token
        if not token:
            return runs


@contextmanager
def _store_lock(uri: str) -> Iterator[None]:
    """Lock all SQLite stores, so that one process at a time creates tables and experiments."""
    if sqlite_file(uri) is None:
        yield
        return
    with (require_cache_folder() / "stores.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def first_line(error: Exception) -> str:
    """Return the first line of a message, the name of the error where it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0]
