"""MLflow's server for the UI: on loopback, with one worker and without telemetry.

With its default settings the server (3.17) has ten processes and runs jobs and telemetry.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from torchmbd.errors import InputError
from torchmbd.tracking.store import ARTIFACTS, TrackingError, open_store
from torchmbd.tracking.uri import StoreURI

_START_SECONDS = 60
QUIET = {
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "GIT_PYTHON_REFRESH": "quiet",
    "PYTHONSAFEPATH": "1",  # a random.py of the current folder is none of the server's modules
}


@contextmanager
def serving(uri: StoreURI | str, host: str = "127.0.0.1", port: int = 5000) -> Iterator[subprocess.Popen]:
    """Serve a store until the block is left; TrackingError if the server does not start.

    The tables of a new store are created first, since several processes of the server must not do it at once.
    """
    _require_free(host, port)
    uri = StoreURI(uri)
    open_store(uri)
    command = [sys.executable, "-m", "mlflow", "server", "--host", host, "--port", str(port), "--workers", "1"]
    if file := uri.file:
        command += ["--default-artifact-root", ARTIFACTS, "--artifacts-destination", str(file.parent / "mlartifacts")]
    process = subprocess.Popen(
        command,
        env={**os.environ, **QUIET, "MLFLOW_BACKEND_STORE_URI": uri.whole},  # others can read a command line
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        _wait_until_up(process, host, port)
        yield process
    finally:
        _stop(process)


def _require_free(host: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            raise InputError(
                "port",
                port,
                noun=f"port = {port} of {host}",
                state=f"cannot be used ({error})",
                hint="another --port",
            ) from None


def _wait_until_up(process: subprocess.Popen, host: str, port: int) -> None:
    for _ in range(10 * _START_SECONDS):
        try:
            socket.create_connection((host, port), timeout=1).close()
        except OSError:
            try:
                code = process.wait(timeout=0.1)
            except subprocess.TimeoutExpired:
                continue
            raise TrackingError(f"the MLflow server ended with exit code {code} before it answered") from None
        else:
            return
    raise TrackingError(f"the MLflow server does not answer on {host}:{port} after {_START_SECONDS} s")


def _stop(process: subprocess.Popen) -> None:
    """End the server and its worker: they share a session of their own."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
