"""The process that brings a study's journal into the store; see process.py.

A line is sent until the store takes it. If it fails, is the store there at all? If not, the writer tries again, for
as long as the study lives and `PATIENCE` seconds longer. If it is, the line itself is at fault: it is noted and left out.
Between two batches the writer rests, for it shares the cores with the study's workers: much at once costs hardly more than
little, and many runs take a second each time.
What is sent is noted in sent.json after every batch; where a run that is told twice would be there twice, after every new run.
"""

from __future__ import annotations

import json
import os
import sqlite3
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from torchmbd.process import come_forward, give_way
from torchmbd.tracking.spool import (
    Sent,
    Told,
    clear,
    drop_session,
    drop_sessions,
    empty,
    last_session,
    load_sent,
    locked,
    read_lines,
    save_sent,
)
from torchmbd.tracking.tracker import TrackingError

if TYPE_CHECKING:
    from torchmbd.tracking.mlflow_tracker import MlflowTracker

PATIENCE = float(os.environ.get("TORCHMBD_PATIENCE", "15"))  # seconds for a store that is away when the study is over
_POLL, _PAUSE = 0.1, (0.5, 1.0, 2.0, 5.0, 10.0)  # seconds
_REST, _SHARE = 1.0, 0.1  # seconds between two batches at least; of a core at most while the study computes


class Away(Exception):
    """The store does not answer."""


@dataclass
class Writer:
    """Sends one session of one folder."""

    folder: Path
    file: Path
    over: Callable[[], bool]  # whether the study is
    hasty: Callable[[], bool] = lambda: False  # whether somebody will wait soon: no more rest
    patience: float = PATIENCE
    tracker: MlflowTracker | None = None
    sent: Sent = field(default_factory=Sent)
    where: list[str | None] = field(default_factory=list)  # experiment, uri, study
    when: int | None = None  # the last line was told
    _heard: int = 0  # offset behind the last line that the tracker was told
    _opened_at: float = 0.0  # processor time when the store was opened: making one, once, is nothing to rest from
    _ended: float | None = None

    def run(self) -> dict:
        """Send until the study is over and everything of it is in the store; return the last word."""
        self.sent = load_sent(self.folder)
        if self.sent.session != self.file.stem:  # of an earlier life
            root = next(iter(self.sent.runs.values()), self.sent.earlier)
            self.sent = Sent(self.file.stem, steps=self.sent.steps, earlier=root)
        self._heard = self.sent.offset
        drop_sessions(self.folder, before=self.file)
        rested = 0.0
        while True:
            over = self.over()  # asked before the lines are read: what comes later is nothing
            lines = (
                read_lines(self.file, self.sent.offset) if over or self.hasty() or time.monotonic() >= rested else []
            )
            if lines:
                began = time.process_time()
                failure = self._insist(lambda lines=lines: self._send(lines))
                if failure:
                    return {"waiting": failure}
                spent = time.process_time() - max(began, self._opened_at)
                rested = time.monotonic() + max(_REST, spent / _SHARE)
            elif over:
                break
            else:
                time.sleep(_POLL)
        return self._close()

    def _insist(self, action: Callable[[], None]) -> str | None:
        """Do it, again and again while the store is away; return why it was given up."""
        pauses = iter(_PAUSE)
        pause = next(pauses)
        while True:
            try:
                action()
            except Away as error:
                if self.over():
                    self._ended = self._ended or time.monotonic()
                    if time.monotonic() - self._ended > self.patience:
                        return str(error)
                self._sleep(min(pause, _PAUSE[1]) if self.over() else pause)
                pause = next(pauses, pause)
            else:
                return None

    def _sleep(self, seconds: float) -> None:
        """Sleep, until the study is over at most: somebody waits then."""
        over, until = self.over(), time.monotonic() + seconds
        while time.monotonic() < until and self.over() == over:
            time.sleep(_POLL)

    def _send(self, lines: list[Told]) -> None:
        for (method, *arguments), end, when in lines:
            if end <= self._heard:
                continue  # before the store went away
            self.when = when
            if method == "session":
                self.where = arguments
            elif method != "close":
                self._command(method, arguments)
            self._heard = end
            if method == "begin" and self.tracker is not None and not self.tracker.store.repeatable:
                self._flush()  # told again, this run would be there twice
                self._note(end)
        self._flush()
        self._note(lines[-1].end)

    def _command(self, method: str, arguments: list) -> None:
        try:
            tracker = self._opened()
            tracker.when = self.when
            getattr(tracker, method)(*arguments)
        except Away:
            raise
        except Exception as error:  # MLflow's, the database's, the network's: told apart by asking the store
            self._require_store(error)
            self.sent.refused.append(f"{method} {arguments[0] if arguments else ''}: {_first_line(error)}")

    def _flush(self) -> None:
        if self.tracker is None:
            return
        try:
            self.tracker.flush()
        except Exception as error:
            self._require_store(error)
            for run in self.tracker.waiting:
                self._flush_one(self.tracker, run)

    def _flush_one(self, tracker: MlflowTracker, run: str) -> None:
        """Write what waits of one run: what the store refuses of it costs the others nothing."""
        try:
            tracker.flush(run)
        except Exception as error:
            self._require_store(error)
            self.sent.refused.append(f"what was told of {run}: {_first_line(error)}")
            tracker.forget(run)

    def _opened(self) -> MlflowTracker:
        if self.tracker is None:
            from torchmbd.tracking.mlflow_tracker import MlflowTracker

            experiment, uri, study = self.where or read_lines(self.file, 0)[0].line[1:]
            try:
                own = self.sent
                self.tracker = MlflowTracker(str(experiment), uri, study, own.runs, own.steps, own.earlier, own.session)
            except (TrackingError, OSError) as error:
                raise Away(_first_line(error)) from error
            self._opened_at = time.process_time()
        return self.tracker

    def _require_store(self, error: Exception) -> None:
        """Raise Away unless the store can be read and written.

        A database that was locked or full was away, though it may be there again.
        """
        if isinstance(error, sqlite3.OperationalError):
            raise Away(_first_line(error)) from error
        try:
            if self.tracker is None:
                raise error
            self.tracker.store.probe()
        except Exception as reason:
            raise Away(_first_line(reason)) from error

    def _note(self, offset: int) -> None:
        self.sent.offset = offset
        if self.tracker is not None:
            self.sent.runs, self.sent.steps = self.tracker.runs, self.tracker.steps
        try:
            save_sent(self.folder, self.sent)
        except OSError as error:
            raise Away(f"{self.folder}: {error.strerror}") from error

    def _close(self) -> dict:
        if self.tracker is None and not self.sent.runs:  # refused at the door: no store is created for it
            drop_session(self.file)
            return {"uri": "", "experiment_id": "", "runs": {}, "refused": self.sent.refused, "finished": True}
        failure = self._insist(self._end)
        if failure or self.tracker is None:
            return {"waiting": failure or "the store was not opened"}
        record = self.tracker.record()
        return {
            "uri": record.uri,
            "experiment_id": record.experiment_id,
            "runs": record.runs,
            "refused": self.sent.refused,
            "finished": self.tracker.finished,
        }

    def _end(self) -> None:
        tracker = self._opened()
        tracker.when = self.when
        try:
            tracker.close()
        except Exception as error:
            self._require_store(error)
            self.sent.refused.append(f"end: {_first_line(error)}")
        self.sent.closed = True
        self._note(self.sent.offset)
        drop_session(self.file)


def deliver(folder: Path, patience: float = PATIENCE) -> str | None:
    """Send what a study that is over has left in its folder; return why it still waits, None if it does not."""
    file = last_session(folder)
    if file is None:
        return None
    with ExitStack() as held:
        with locked(folder, "study.lock", wait=False) as over:
            if not over:
                return None  # it lives, and has a writer of its own
            if not held.enter_context(locked(folder, "writer.lock", wait=False)) or not file.exists():
                return None
        word = Writer(
            folder, file, lambda: True, patience=patience
        ).run()  # the study may go on meanwhile: its writer waits
        with locked(folder, "study.lock", wait=False) as over:
            if over and word.get("finished"):
                (empty if word["runs"] else clear)(folder)
    return word.get("waiting")


def main(folder: str, mode: str = "") -> int:
    """Run the writer of a study (its last line of output is its last word), or deliver a whole place (`--all`)."""
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")  # trying again is the writer's own affair
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
    place = Path(folder)
    if mode == "--all":
        waiting = {left: reason for left in sorted(place.glob("*/")) if (reason := deliver(left))}
        for left, reason in waiting.items():
            print(f"{left} waits for its store: {reason}")
        return len(waiting)
    file = last_session(place)
    assert file is not None
    ended, hasty = threading.Event(), threading.Event()

    def listen() -> None:
        for _ in sys.stdin:
            hasty.set()
        ended.set()
        come_forward()

    threading.Thread(target=listen, daemon=True).start()
    give_way()
    with locked(place, "writer.lock"):  # the writer of a study that was killed may still be at work
        word = Writer(place, file, ended.is_set, hasty.is_set).run()
    print(json.dumps(word))
    return 0


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
