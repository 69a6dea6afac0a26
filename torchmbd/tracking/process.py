"""Tracking in a process of its own: the study waits for no database, and a study that dies leaves no run RUNNING.

    study                                        writer (`main` of this file)
    ProcessTracker.metrics(...)  -- JSON line -> queue -> MlflowTracker.metrics(...)
    ProcessTracker.close()       -- end of file -> MlflowTracker.close() -- JSON line -> Record

The writer imports MLflow (3 s) and migrates the store beside the study's own start. It reads its input ahead of its
writing, so the study never blocks on a slow store, and whatever has gathered meanwhile is written as one batch.
When the study is killed, its end of the pipe closes: the writer then ends every open run as KILLED.
It has a session of its own: Ctrl-C in the terminal is the study's to handle.
"""

from __future__ import annotations

import importlib
import json
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchmbd.errors import MbdError
from torchmbd.tracking.tracker import Record, Status, TrackingError

# The package without its __init__, which imports torch: 3 seconds and 250 MB that the writer has no use for.
_BOOT = """
import sys, types
package = types.ModuleType("torchmbd")
package.__path__ = [sys.argv[1]]
sys.modules["torchmbd"] = package
from torchmbd.tracking.process import main
sys.exit(main(sys.argv[2]))
"""


class ProcessTracker:
    """Keeps the contract of torchmbd.tracking.tracker in another process."""

    def __init__(self, experiment: str, uri: str | None = None) -> None:
        package = Path(__file__).parents[1]
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 - read when the writer fails, closed in close()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _BOOT, str(package), json.dumps([experiment, uri])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,
            text=True,
        )
        self._broken = False

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        self._send("begin", run, name, parent, {key: str(value) for key, value in (params or {}).items()}, tags or {})

    def metrics(self, run: str, values: Mapping[str, float], step: int = 0) -> None:
        self._send("metrics", run, {key: float(value) for key, value in values.items()}, step)

    def tags(self, run: str, values: Mapping[str, str]) -> None:
        self._send("tags", run, dict(values))

    def artifact(self, run: str, file: str | Path, folder: str = "") -> None:
        self._send("artifact", run, str(Path(file).absolute()), folder)

    def view(self, run: str, columns: Sequence[str], order_by: str) -> None:
        self._send("view", run, list(columns), order_by)

    def end(self, run: str, status: Status) -> None:
        self._send("end", run, status)

    def close(self) -> Record:
        """Wait until everything is written; TrackingError if anything was not."""
        try:
            answer, _ = self._process.communicate()
            lines = [line for line in answer.splitlines() if line.startswith("{")]
            reply: dict[str, Any] = (
                json.loads(lines[-1]) if lines else {"failure": f"the writer died: {self._last_words()}"}
            )
        finally:
            self._log.close()
        if "failure" in reply:
            raise TrackingError(reply["failure"])
        return Record(**reply)

    @property
    def lost(self) -> bool:
        """Whether the writer is gone: what comes from now on is not recorded, close() will tell why."""
        return self._broken or self._process.poll() is not None

    def _send(self, method: str, *arguments: object) -> None:
        if self._broken:
            return
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps([method, *arguments]) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self._broken = True

    def _last_words(self) -> str:
        self._log.seek(0)
        return (self._log.read().strip().splitlines() or ["no message"])[-1]


def write(experiment: str, uri: str | None) -> Record:
    """Carry out what comes on standard input until it ends."""
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    threading.Thread(target=_read_ahead, args=(lines,), daemon=True).start()
    importlib.import_module("mlflow")  # 3 seconds, while the study begins
    first = lines.get()  # a study that is refused at the door ends here and creates no store
    if first is None:
        return Record(uri or "", "")
    from torchmbd.tracking.mlflow_tracker import MlflowTracker

    tracker = MlflowTracker(experiment, uri)
    line: str | None = first
    try:
        while line is not None:
            method, *arguments = json.loads(line)
            getattr(tracker, method)(*arguments)
            if lines.empty():
                tracker.flush()
            line = lines.get()
    finally:
        record = tracker.close()  # also when a write has failed: no run of a dead writer is RUNNING
    return record


def _read_ahead(lines: queue.SimpleQueue[str | None]) -> None:
    for line in sys.stdin:
        if line.endswith("\n"):  # a line cut short by the study's death says nothing
            lines.put(line)
    lines.put(None)


def main(where: str) -> int:
    """Run the writer; its last line of output is the record or the failure."""
    try:
        record = write(*json.loads(where))
    except MbdError as error:
        print(json.dumps({"failure": str(error)}))
        return 1
    print(json.dumps({"uri": record.uri, "experiment_id": record.experiment_id, "runs": record.runs}))
    return 0
