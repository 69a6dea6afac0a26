"""A StudyStore in a process of its own: MLflow is imported there, beside the search and not in its interpreter.

    this process                            that one
    write(run, draft)    -- pickle -->      StudyStore.write
                         <-- reply --       why it failed, or None; ids of the runs; what the store refused

It ends with this process, however this ends, and at once: its input is at its end then. It is in a session of its own, so
that Ctrl-C reaches the study alone, which then says what is to be written. One that was killed is started again: it finds the
runs of the study in the store.
Checked in tests/tracking/test_store_process.py.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
import time
from queue import Queue
from typing import Any, NamedTuple

from torchmbd.tracking.run_process import process_tag
from torchmbd.tracking.store import first_line
from torchmbd.tracking.study_store import PendingRun, StudyStore
from torchmbd.tracking.tracker import TrackingError
from torchmbd.tracking.uri import StoreURI

_SERVE = "import sys; sys.path[:] = {path!r}; from torchmbd.tracking.store_process import serve; serve()"


class _Reply(NamedTuple):
    """What there is in the store after a call."""

    trouble: str | None  # why the call failed
    experiment_id: str
    ids: dict[str, str]
    refused: list[str]
    processor_time: float


class StoreProcess:
    """As StudyStore, see the module header."""

    def __init__(self, experiment: str, uri: StoreURI, study: str) -> None:
        self._arguments = experiment, uri, study, process_tag()
        self._process: subprocess.Popen[bytes] | None = None
        self._last = _Reply(None, "", {}, [], 0.0)
        self._refused: list[str] = []  # of processes that were killed

    @property
    def experiment_id(self) -> str:
        return self._last.experiment_id

    @property
    def ids(self) -> dict[str, str]:
        """Of the runs, by their keys."""
        return self._last.ids

    @property
    def refused(self) -> list[str]:
        return self._refused + self._last.refused

    def processor_time(self) -> float:
        """Processor time of the process [s]."""
        return self._last.processor_time

    def write(self, run: str, draft: PendingRun) -> None:
        """See StudyStore. TrackingError if the store does not answer."""
        self._call("write", run, draft)

    def opened(self) -> None:
        """TrackingError if the store cannot be opened."""
        self._call("opened")

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.communicate()

    def _call(self, name: str, *arguments: Any) -> None:
        if self._process is None:
            command = [sys.executable, "-c", _SERVE.format(path=sys.path)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
            self._send(self._arguments)
        self._last = self._send((name, arguments))
        if self._last.trouble is not None:
            raise TrackingError(self._last.trouble)

    def _send(self, message: Any) -> _Reply:
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            pickle.dump(message, process.stdin)
            process.stdin.flush()
            return pickle.load(process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            self._process, self._refused = None, self.refused
            self._last = self._last._replace(refused=[])
            process.kill()
            process.communicate()
            raise TrackingError(f"the process that writes ended with {process.returncode}") from None


def serve() -> None:
    """What the process does: calls from standard input, replies to what was standard output."""
    calls: Queue[Any] = Queue()
    threading.Thread(target=_listen, args=(calls,), daemon=True).start()
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what MLflow prints is no reply
    store, trouble = StudyStore(*calls.get()), None
    while True:
        pickle.dump(_Reply(trouble, store.experiment_id, store.ids, store.refused, time.process_time()), replies)
        replies.flush()
        name, arguments = calls.get()
        try:
            getattr(store, name)(*arguments)
            trouble = None
        except Exception as error:  # of MLflow, the database or the network: the study tries again
            trouble = first_line(error)


def _listen(calls: Queue[Any]) -> None:
    """Read calls; at their end the study has ended, and whatever is being written with it: the next one goes on."""
    try:
        while True:
            calls.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):
        os._exit(0)
