"""Workers on this machine that only the process that started them reaches, as Dask runs what it is sent.

The scheduler, the workers and the processes that watch over them (nannies) listen on loopback, where any user of the machine
may connect. So all of them speak TLS, and ask for a certificate that is made for this study and exists in its processes alone.
Dask's own LocalCluster opens a port of plain HTTP for the scheduler and for every worker: here there is none.
Checked in tests/study/test_dask_evaluator.py.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from typing import Any

import cryptography  # noqa: F401  what Security.temporary needs: the error names the package
from distributed import Nanny, Scheduler, Security, SpecCluster, Worker  # pyright: ignore[reportMissingImports]

HOST = "127.0.0.1"


class _Scheduler(Scheduler):
    def start_http_server(self, *_: object, **__: object) -> None:
        """Open no port."""


class _Worker(Worker):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal is the study's to handle
        super().__init__(*arguments, **options)

    def start_http_server(self, *_: object, **__: object) -> None:
        """Open no port."""


def start_local_cluster(workers: int, module: str) -> SpecCluster:
    """Start so many processes of one thread each, `module` imported."""
    os.environ.setdefault("PYTHONSAFEPATH", "1")  # no module of the current folder hides one of Python's
    multiprocessing.set_forkserver_preload(["distributed", "torchmbd.api", module])  # imported once for all workers
    security = Security.temporary()
    options = {"host": HOST, "protocol": "tls://", "security": security}
    worker_options = {"worker_class": _Worker, "nthreads": 1, "memory_limit": 0, "silence_logs": logging.CRITICAL}
    return SpecCluster(
        scheduler={"cls": _Scheduler, "options": {**options, "port": 0, "dashboard": False}},
        workers={i: {"cls": Nanny, "options": options | worker_options} for i in range(workers)},
        security=security,
        silence_logs=logging.CRITICAL,  # pyright: ignore[reportArgumentType]
    )
