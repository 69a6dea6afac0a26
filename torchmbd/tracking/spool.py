"""The folder of a study: what it tells its tracker, on disk before anything else, until a store has it.

    <session>.jsonl   one line for each call of a tracker, in order, [ms since 1970, [method, *arguments]];
                      a session is one life of the study's process
    sent.json         how far which session is in the store: bytes, run ids, last steps of metrics
                      its runs are gone on with by the next session, whatever their status, while this file is here
    files/            what the study files (pictures, tables)
    study.lock        held by the process of the study: the same study cannot run twice at once
    writer.lock       held by the process that writes to the store

A study that goes on after a death tells everything again in a new session (its evaluations come from
torchmbd.experiment.evaluations), so the journal of an earlier session is superseded as soon as a new one begins.
The folder goes when the study's own process has said on the screen that it finished: one that is killed before that, even
with everything in the store, is ended by the same command, not begun anew.
Locks are the kernel's: they end with their process, however it ends.
Checked in tests/tracking/test_spool.py.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

Line = list[Any]  # [method, *arguments], plain JSON


class Told(NamedTuple):
    """A line of a journal."""

    line: Line
    end: int  # offset behind it [bytes]
    when: int  # it was told [ms since 1970]


@dataclass
class Sent:
    """What of a session is in the store."""

    session: str = ""
    offset: int = 0  # bytes of the session's journal
    runs: dict[str, str] = field(default_factory=dict)  # run id of every key, of this session
    # Of every metric of every run the last step, and the values that were told there: [step, [value, ...]].
    steps: dict[str, dict[str, list[Any]]] = field(default_factory=dict)
    earlier: str = ""  # run id of the root in an earlier session, which this one goes on with
    refused: list[str] = field(default_factory=list)  # what the store would not take, though it answers
    closed: bool = False  # everything of the session is there, no run is open


class Journal:
    """Appends the lines of one session; what the disk does not take is held back until it does."""

    def __init__(self, folder: Path, head: Line) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        # Later than every session before it, also where the clock has been set back since.
        earlier = [load_sent(folder).session or "0", *(file.stem for file in folder.glob("*.jsonl"))]
        self.session = str(max(time.time_ns(), *(int(session) + 1 for session in earlier)))
        self.file = folder / f"{self.session}.jsonl"
        self._good = 0
        self._held: list[str] = []
        self.trouble: str | None = None  # why lines are held back
        self._descriptor = os.open(self.file, os.O_CREAT | os.O_RDWR, 0o600)
        self.append(head)

    def append(self, line: Line) -> None:
        """Write a line, and whatever was held back before it."""
        self._held.append(json.dumps([int(1000 * time.time()), line]) + "\n")
        data = "".join(self._held).encode()
        try:
            written = os.pwrite(self._descriptor, data, self._good)
            if written < len(data):
                raise OSError(28, os.strerror(28))
        except OSError as error:
            self.trouble = error.strerror
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._good)  # a line is there as a whole or not at all
            return
        self._good += len(data)
        self._held.clear()
        self.trouble = None

    @property
    def held(self) -> int:
        """Lines that are not on disk."""
        return len(self._held)

    def close(self) -> None:
        os.close(self._descriptor)


def read_lines(file: Path, offset: int) -> list[Told]:
    """Return the whole lines behind `offset`, up to one that a power cut has torn."""
    with file.open("rb") as journal:
        journal.seek(offset)
        data = journal.read()
    lines = []
    for raw in data[: data.rfind(b"\n") + 1].splitlines():
        offset += len(raw) + 1
        try:
            when, line = json.loads(raw)
        except ValueError:
            break
        lines.append(Told(line, offset, when))
    return lines


def load_sent(folder: Path) -> Sent:
    """Read sent.json; nothing is sent where there is none, or where a power cut left half of one."""
    try:
        return Sent(**json.loads((folder / "sent.json").read_text(encoding="utf-8")))
    except (FileNotFoundError, ValueError, TypeError):
        return Sent()


def save_sent(folder: Path, sent: Sent) -> None:
    """Replace sent.json as a whole."""
    draft = folder / "sent.json.new"
    draft.write_text(json.dumps(asdict(sent)), encoding="utf-8")
    draft.replace(folder / "sent.json")


def last_session(folder: Path) -> Path | None:
    """Return the journal of the latest session."""
    return max(folder.glob("*.jsonl"), default=None, key=lambda file: int(file.stem))


def drop_sessions(folder: Path, before: Path) -> None:
    """Remove the journals of the sessions before one, which has told everything again."""
    for file in folder.glob("*.jsonl"):
        if int(file.stem) < int(before.stem):
            file.unlink(missing_ok=True)


def drop_session(file: Path) -> None:
    """Remove a journal that the store has as a whole."""
    file.unlink(missing_ok=True)


def clear(folder: Path) -> None:
    """Remove the folder of a study that has told its end: nothing is left to go on with."""
    shutil.rmtree(folder, ignore_errors=True)


def empty(folder: Path) -> None:
    """Remove the files of a study, which a store has; what it takes to go on with its runs stays."""
    shutil.rmtree(folder / "files", ignore_errors=True)


@contextlib.contextmanager
def locked(folder: Path, name: str, wait: bool = True) -> Iterator[bool]:
    """Hold a lock of the folder; yields whether it is held. Without `wait` another holder is not waited for."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / name).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
        else:
            yield True
