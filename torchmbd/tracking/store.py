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
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from torchmbd.errors import InputError, MbdError
from torchmbd.process import require_cache_folder, utf8
from torchmbd.tracking.uri import MASK, StoreURI

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
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",  # two lines for every run, with the user part of the URI
}


Status = Literal["FINISHED", "FAILED", "KILLED"]  # of a run that has ended


class TrackingError(MbdError):
    """The store could not be opened or written."""


def store_uri(uri: str | StoreURI | None = None) -> StoreURI:
    """Return the URI of the store to use, a SQLite path made absolute; InputError if it is not a URI of a store."""
    name = "uri" if uri else "MLFLOW_TRACKING_URI" if os.environ.get("MLFLOW_TRACKING_URI") else "the store"
    chosen = checked_uri(uri or os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{Path.cwd() / 'mlflow.db'}", name)
    if chosen.masked:
        raise InputError(
            name,
            chosen,
            "the whole URI",
            hint="MLFLOW_TRACKING_URI",
            shown=repr(chosen),
            state=f"has {MASK}, which hides a part of the URI",
        )
    if chosen.file is None:
        return chosen
    paths = [text for text in (str(chosen.file), str(Path.cwd())) if utf8(text) != text]
    if paths and not chosen.file.exists():  # MLflow writes both into a new store
        raise InputError(
            name,
            utf8(str(chosen)),
            shown=repr(utf8(str(chosen))),
            state=f"has the name {utf8(paths[0])!r}, which cannot be written in the encoding of this locale, "
            f"{sys.getfilesystemencoding()}",
            hint="PYTHONUTF8=1, or a locale of UTF-8",
        )
    return StoreURI(f"sqlite:///{chosen.file}")


def checked_uri(uri: str | StoreURI, name: str = "uri") -> StoreURI:
    """Return the URI of a store as it is; InputError, which names the argument `name`, if it is none."""
    if not isinstance(uri, (str, StoreURI)):
        raise InputError(name, uri, "a store such as sqlite:///mlflow.db")
    checked = StoreURI(uri)
    if refusal := uri_fault(checked):
        raise InputError(name, checked, *refusal)
    return checked


def uri_fault(uri: StoreURI) -> tuple[str, str] | None:
    """Return what is allowed in place of a URI that is not a store, and a remedy; None if it may be one."""
    scheme, separator, place = uri.whole.partition("://")
    if not separator or scheme.partition("+")[0] not in SCHEMES or (scheme == "sqlite" and place[:1] != "/"):
        return f"a store of {', '.join(f'{name}:' for name in SCHEMES)}, such as sqlite:///mlflow.db", ""
    file = uri.file
    if file and any(c in str(file) for c in _MISREAD):
        return f"a path without {' and '.join(_MISREAD)}, which MLflow misreads", "MLFLOW_TRACKING_URI"
    return None


def own_files(uri: StoreURI, run_id: str) -> Path | None:
    """Return the folder of a run's files beside a SQLite store (absolute), whether it exists or not; None for others."""
    return None if uri.file is None else uri.file.parent / "mlartifacts" / run_id / "artifacts"


def relative_to_store(uri: StoreURI, file: Path) -> str:
    """Return a path relative to the folder of a SQLite store; for other stores, to the working directory."""
    return os.path.relpath(file, Path.cwd() if uri.file is None else uri.file.parent)


def open_store(uri: StoreURI | str) -> MlflowClient:
    """Open a store, creating its tables if it is new; TrackingError if it cannot be opened."""
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    for name in ("urllib3", "mlflow.store.db"):  # retries, tracebacks; how they end is reported, without the user
        logging.getLogger(name).setLevel(logging.CRITICAL)
    from mlflow import MlflowClient  # takes 3 seconds
    from mlflow.exceptions import MlflowException

    uri = StoreURI(uri)
    try:
        with _store_lock(uri):
            if uri.file:
                _require_file(uri.file)
            client = MlflowClient(uri.whole)
            client.search_experiments(max_results=1)
    except (
        MlflowException,
        OSError,
        sqlite3.Error,
        ImportError,
    ) as error:  # its text, and those before it, may show the user
        raise TrackingError(f"the store {uri!r} cannot be opened: {uri.hide(first_line(error))}") from None
    return client


def _require_file(file: Path) -> None:
    """Create a SQLite store that does not exist; one with some of its tables could not be completed later."""
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    file.parent.mkdir(parents=True, exist_ok=True)
    if file.exists():
        with closing(sqlite3.connect(file)) as base:  # MLflow would try for minutes to open a file that is no store
            base.execute("pragma user_version")
        return
    with tempfile.TemporaryDirectory(prefix=f".{file.name}-", dir=file.parent) as folder:
        draft = Path(folder) / file.name
        SqlAlchemyStore(f"sqlite:///{draft}", ARTIFACTS)  # its experiment "Default" too has its files beside the store
        draft.replace(file)


def experiment_id(client: MlflowClient, name: str, uri: StoreURI) -> str:
    """Return the id of an experiment, creating it if it is new."""
    with _store_lock(uri):
        experiment = client.get_experiment_by_name(name)
        if experiment is None:
            return client.create_experiment(name, artifact_location=ARTIFACTS if uri.file else None)
    if experiment.lifecycle_stage != "active":
        raise TrackingError(f"experiment {name!r} is deleted in {uri}; restore it there or choose another name")
    return experiment.experiment_id


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
def _store_lock(uri: StoreURI) -> Iterator[None]:
    """Lock all SQLite stores, so that one process at a time creates tables and experiments."""
    if uri.file is None:
        yield
        return
    with (require_cache_folder() / "stores.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def first_line(error: Exception) -> str:
    """Return the first line of a message, the name of the error where it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0]
