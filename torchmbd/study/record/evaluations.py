"""The evaluations of all studies on disk, written as soon as they are computed: no design is simulated twice.

    problem    hash of all that the numbers depend on (paths.problem_key)
    design     design vector [n] float64, bit for bit                      gradients  whether they were requested
    status     "ok", or the reason of the failure
    numbers    objective, constraints [m], gradients [n], [m, n] as float64; behind them the checksum of the row: an altered
               row is reported, and evaluated again

Optimizers are deterministic, so a study that was killed asks for the same designs again when it is continued: all of them
up to the batch that was being computed are found here.
SQLite, one transaction for each batch, which is on disk before it is returned. A batch that cannot be written (full disk) is
kept in memory, reported once, and written together with a later batch.
A library for caches on disk keeps what it is given under a key: checksums, batches that wait for a full disk to have room, and
all designs of one problem would stand here all the same.
Assumed: a law that reads a file, or imports a module, while it is evaluated, always finds the same contents.
Checked in tests/study/record/test_evaluations.py.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.errors import MbdError, warn
from torchmbd.optimization import Evaluation

_TABLE = """
create table if not exists evaluations (
    problem text, design blob, gradients integer, m integer, status text, numbers blob,
    primary key (problem, design, gradients)
) without rowid
"""
_CHECKSUM = 16  # bytes
_SECONDS = 60  # to wait for another study that is writing


class Evaluations:
    """The evaluations of one problem in a file that many studies share."""

    def __init__(self, file: Path, problem: str) -> None:
        self.file, self.problem = file, problem
        self.trouble: str | None = None  # why evaluations are kept in memory
        self._waiting: dict[tuple[bytes, bool], tuple[int, str, bytes]] = {}
        try:
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            file.touch(mode=0o600)
            self._base = sqlite3.connect(file, timeout=_SECONDS)
            self._base.execute("pragma journal_mode=wal")
            self._base.execute("pragma synchronous=full")  # a power cut costs no batch either
            self._base.execute(_TABLE)
        except (OSError, sqlite3.Error) as error:
            raise MbdError(f"the store of evaluations {file} cannot be opened: {error}") from error

    def find(self, X: np.ndarray, gradients: bool) -> list[Evaluation | None]:
        """Return the evaluation of each design [lanes, n], None where it is not stored."""
        return [self._row(np.ascontiguousarray(x, dtype=np.float64), gradients) for x in X]

    def _row(self, x: np.ndarray, gradients: bool) -> Evaluation | None:
        key = x.tobytes(), gradients
        if key in self._waiting:
            return _evaluation(*self._waiting[key], len(x), gradients)
        query = "select m, status, numbers from evaluations where problem = ? and design = ? and gradients = ?"
        for m, status, sealed in self._select(query, (self.problem, *key)):
            numbers = self._checked((*key, m, status), sealed)
            return None if numbers is None else _evaluation(m, status, numbers, len(x), gradients)
        return None

    def _select(self, query: str, values: Sequence[Any]) -> list[Any]:
        try:
            return self._base.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise MbdError(
                f"the store of evaluations {self.file} cannot be read: {error}; without the file all begins anew"
            ) from error

    def _checksum(self, row: tuple[Any, ...], numbers: bytes) -> bytes:
        """Return the checksum of an evaluation; `row` is its design, gradients, m and status."""
        digest = hashlib.sha256(repr((self.problem, *row)).encode())
        digest.update(numbers)
        return digest.digest()[:_CHECKSUM]

    def _checked(self, row: tuple[bytes, Any, Any, Any], sealed: Any) -> bytes | None:
        """Return the numbers of a row without their checksum; None, with a warning, if the checksum does not fit."""
        numbers = bytes(sealed[:-_CHECKSUM]) if isinstance(sealed, bytes) else b""
        design, gradients, m, status = row
        if numbers and sealed == numbers + self._checksum((design, bool(gradients), m, status), numbers):
            return numbers
        warn(
            f"an evaluation in {self.file} was altered after it was written. torchmbd does not use it, and computes it again",
        )
        return None

    def keep(self, X: np.ndarray, gradients: bool, evaluations: Sequence[Evaluation]) -> None:
        """Write a batch, together with those that could not be written before."""
        for x, evaluation in zip(X, evaluations, strict=True):
            self._waiting[np.ascontiguousarray(x, dtype=np.float64).tobytes(), gradients] = _numbers(evaluation)
        rows = [
            (self.problem, *key, m, status, numbers + self._checksum((*key, m, status), numbers))
            for key, (m, status, numbers) in self._waiting.items()
        ]
        try:
            with self._base:
                self._base.executemany("insert or replace into evaluations values (?, ?, ?, ?, ?, ?)", rows)
        except sqlite3.Error as error:
            self.trouble = str(error)
        else:
            self.trouble = None
            self._waiting.clear()

    def forget(self) -> None:
        """Remove the evaluations of this problem."""
        try:
            with self._base:
                self._base.execute("delete from evaluations where problem = ?", (self.problem,))
        except sqlite3.Error as error:
            raise MbdError(f"the store of evaluations {self.file} cannot be written: {error}") from error

    def count(self) -> int:
        """Return the number of evaluations of this problem on disk."""
        query = "select count(*) from evaluations where problem = ?"
        return int(self._select(query, (self.problem,))[0][0])

    def visited(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return every design [m, n] of this problem on disk with its objective [m], nan where it failed."""
        query = "select design, gradients, m, status, numbers from evaluations where problem = ?"
        values = {
            row[0]: numbers
            for *row, sealed in self._select(query, (self.problem,))
            if (numbers := self._checked((row[0], row[1], row[2], row[3]), sealed)) is not None
        }
        designs = np.array([np.frombuffer(design) for design in values]).reshape(-1, n)
        return designs, np.array([np.frombuffer(numbers)[0] for numbers in values.values()])

    def close(self) -> None:
        self._base.close()


def _numbers(evaluation: Evaluation) -> tuple[int, str, bytes]:
    parts = [np.array([evaluation.objective]), np.atleast_1d(evaluation.constraints)]
    if evaluation.objective_gradient is not None and evaluation.constraint_gradients is not None:
        parts += [evaluation.objective_gradient, np.asarray(evaluation.constraint_gradients).ravel()]
    return len(parts[1]), evaluation.status, np.concatenate(parts).astype(np.float64).tobytes()


def _evaluation(m: int, status: str, numbers: bytes, n: int, gradients: bool) -> Evaluation:
    x = np.frombuffer(numbers).copy()
    if not gradients or len(x) == 1 + m:  # a failed evaluation has no gradients
        return Evaluation(float(x[0]), x[1 : 1 + m], status=status)
    slopes = x[1 + m :].reshape(1 + m, n)
    return Evaluation(float(x[0]), x[1 : 1 + m], slopes[0], slopes[1:], status)
