"""Tracking in a process of its own: the study waits for no store, loses nothing to one that is away, and dies cleanly.

    study                                           writer (writer.py)
    ProcessTracker.metrics(...) -> journal on disk -> MlflowTracker.metrics(...)
    the last child has ended    -> a line in its pipe  what it has saved up
    ProcessTracker.close()      -> end of its pipe -> MlflowTracker.close() -> JSON line: Record

The journal (spool.py) is the truth, the store a copy of it that may lag behind: a server that is away for minutes is
caught up with, a writer that is killed is replaced by another that goes on at the same line, and what is not in the
store when the study ends is sent by the next study of the same place, or by `deliver_all`.
When the study is killed, its end of the pipe closes: the writer then ends every open run as KILLED.
The writer has a session of its own: Ctrl-C in the terminal is the study's to handle. Where it needs MLflow, it imports
it (3 s) and makes the store's tables beside the study's own start.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
import uuid
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torchmbd.bare import command
from torchmbd.errors import MbdError
from torchmbd.tracking.spool import Journal, clear, locked
from torchmbd.tracking.store import store_uri
from torchmbd.tracking.tracker import Record, Status, TrackingError

_WRITER = "torchmbd.tracking.writer"
_WRITERS = 5  # that may die before the study goes on without


class ProcessTracker:
    """Keeps the contract of torchmbd.tracking.tracker in another process.

    folder  where the study's journal and files are until the store has them
    study   the same for every life of a study: its unfinished runs are gone on with; None: a new study
    """

    def __init__(self, experiment: str, uri: str | None, folder: Path, study: str | None = None) -> None:
        self.uri = store_uri(uri)  # of this process: another may send it, from another folder
        self.folder = folder
        self._locks = ExitStack()
        if not self._locks.enter_context(locked(self.folder, "study.lock", wait=False)):
            raise MbdError(f"the same study is running in another process (its folder is {self.folder})")
        self._journal = Journal(self.folder, ["session", experiment, self.uri, study or uuid.uuid4().hex])
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 - read when a writer fails, closed in close()
        self._writers = self._open = 0
        self._process = self._start()

    def _start(self) -> subprocess.Popen[str]:
        self._writers += 1
        return subprocess.Popen(
            command(_WRITER, str(self.folder)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,
            text=True,
        )

    @property
    def files(self) -> Path:
        """Where the study puts what it files: it stays until the store has it."""
        folder = self.folder / "files"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def begin(
        self,
        run: str,
        name: str,
        parent: str | None = None,
        params: Mapping[str, object] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        self._open += 1
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
        self._open -= 1
        self._send("end", run, status)
        if self._open <= 1:  # the root only: the study draws its pictures
            self._hasten()

    def _hasten(self) -> None:
        """Tell the writer that soon somebody will wait for it."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died: the next one has all to do
            self._process.stdin.write("\n")
            self._process.stdin.flush()

    def close(self) -> Record:
        """Wait until everything is in the store; TrackingError says what is not, and where it waits."""
        self._send("close")
        held, reply = self._journal.held, self._farewell()
        self._journal.close()
        self._log.close()
        self._locks.close()
        if held:
            raise TrackingError(f"{held} entries could not be written to {self.folder}: {self._journal.trouble}")
        if "waiting" in reply:
            raise TrackingError(
                f"{reply['waiting']}\nNothing is lost: what the store does not have yet waits in {self.folder}; "
                "the next study sends it, or `torchmbd sync`"
            )
        if not reply["runs"]:  # nothing is there to go on with
            clear(self.folder)
        if reply["refused"]:
            raise TrackingError("; ".join(reply["refused"]))
        return Record(reply["uri"], reply["experiment_id"], reply["runs"])

    def conclude(self) -> None:
        """The user knows that the study has finished: the same command begins another, unless one is at it already."""
        with locked(self.folder, "study.lock", wait=False) as mine:
            if mine:
                clear(self.folder)

    def _farewell(self) -> dict[str, Any]:
        """Close the writer's pipe and wait for its answer, from another writer if this one dies on it."""
        while True:
            answer, _ = self._process.communicate()
            lines = [line for line in answer.splitlines() if line.startswith("{")]
            if lines:
                return json.loads(lines[-1])
            if self._writers >= _WRITERS:
                return {"waiting": f"the writer died: {self._last_words()}"}
            self._process = self._start()

    @property
    def trouble(self) -> str | None:
        """What is wrong with the recording now, if anything: the study goes on in any case."""
        if self._journal.trouble:
            return f"the journal of the study cannot be written: {self._journal.trouble}"
        if self._writers >= _WRITERS and self._process.poll() is not None:
            return f"nothing is sent to the tracking store: {self._last_words()}"
        return None

    def _send(self, method: str, *arguments: object) -> None:
        self._journal.append([method, *arguments])
        if self._process.poll() is not None and self._writers < _WRITERS:
            self._process.communicate()
            self._process = self._start()

    def _last_words(self) -> str:
        self._log.seek(0)
        return (self._log.read().strip().splitlines() or ["no message"])[-1]


def deliver_all(place: Path) -> int:
    """Send what studies that are over have left below a folder; return how many still wait for their store."""
    return subprocess.run(_deliverer(place), stdin=subprocess.DEVNULL).returncode


def deliver_soon(place: Path) -> None:
    """The same, without waiting for it: nothing is started where nothing is left."""
    if any(place.glob("*/*.jsonl")):
        nothing = subprocess.DEVNULL
        subprocess.Popen(_deliverer(place), stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True)


def _deliverer(place: Path) -> list[str]:
    return command(_WRITER, str(place), "--all")
