"""Studies and where they stand: what it takes to go on with one that has not finished, or is not in its tracking store.

    .torchmbd/<study>/study.json   name, experiment file (none of a study that Python has made), overrides and store, both as
                                   seen from .torchmbd, which can be copied with them; `id`, by which its runs are found in the
                                   store; whether all its results so far are in it
    .torchmbd/<study>/study.lock   held by the process of the study: the same study cannot run twice at once

As long as a study has not finished, or its store does not have it, the same command goes on with it in its runs, and
`torchmbd sync` sends again what is not in the store: the study is run once more, and every evaluation is taken from the
disk. One that has finished makes no second run; where its store has it no more, or with `fresh`, it begins anew.
Checked in tests/study/test_unfinished.py.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shlex
import shutil
import time
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from torchmbd.errors import InputError, MbdError
from torchmbd.study.paths import place, relative_store

_FILE, _LOCK = "study.json", "study.lock"


@dataclass
class Unfinished:
    """A study and where it stands."""

    folder: Path
    name: str
    file: str | None  # from the folder of all studies
    overrides: list[str]
    store: str  # likewise
    id: str
    sent: bool = False
    run_id: str = ""  # in which it has finished; "": it has not
    ended: str = ""  # when
    continues: bool = False  # an earlier process has begun it

    @property
    def path(self) -> Path | None:
        """Its experiment file."""
        return None if self.file is None else Path(os.path.normpath(self.folder.parent / self.file))

    @property
    def uri(self) -> str:
        """Its store."""
        if not self.store.startswith("sqlite:///"):
            return self.store
        return f"sqlite:///{os.path.normpath(self.folder.parent / self.store.removeprefix('sqlite:///'))}"

    @property
    def command(self) -> str:
        """What goes on with it."""
        if self.path is None:
            return f"run() of mbd.Study(..., name={self.name!r}), in Python"
        return shlex.join(["torchmbd", "run", os.path.relpath(self.path), *self.overrides])

    def mark_sent(self) -> None:
        """Everything that was logged so far is in the store."""
        self.sent = True
        with contextlib.suppress(OSError):  # a disk without room: it is sent once more
            self._write()

    def conclude(self, run_id: str) -> None:
        """It has finished in this run: the same command makes no other."""
        self.run_id, self.ended, self.sent = run_id, time.strftime("%d %b %Y %H:%M"), True
        with contextlib.suppress(OSError):  # a disk without room: the same command goes through it once more
            self._write()

    def renew(self) -> None:
        """Its runs are gone: the same command makes others."""
        self.run_id, self.ended, self.id = "", "", uuid.uuid4().hex
        self._write()

    def forget(self) -> None:
        """Nothing is there to go on with."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _write(self) -> None:
        draft = self.folder / f"{_FILE}.new"
        kept = {k: v for k, v in asdict(self).items() if k not in ("folder", "continues")}
        draft.write_text(json.dumps(kept), encoding="utf-8")
        draft.replace(self.folder / _FILE)


@contextlib.contextmanager
def claimed(
    key: str, name: str, file: Path | None, overrides: Sequence[str], uri: str, fresh: bool = False
) -> Iterator[Unfinished]:
    """Hold a study, so that no other process runs it; MbdError if one does.

    key        its hash (paths.py)                        file, overrides   where it comes from
    uri        its store                                  fresh             not that of an earlier life
    """
    folder = place() / key
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder) as mine:
        if not mine:
            raise MbdError(f"the same study is running in another process (its folder is {folder})")
        earlier = None if fresh else _read(folder)
        seen = None if file is None else os.path.relpath(file, folder.parent)
        study = earlier or Unfinished(folder, name, seen, list(overrides), relative_store(uri), uuid.uuid4().hex)
        study.continues = earlier is not None
        if not study.run_id:
            study.sent = False
            study._write()
        yield study


def unsent() -> list[Unfinished]:
    """Return the studies that are over, with something that is not in their store."""
    found = []
    for file in sorted(place().glob(f"*/{_FILE}")):
        with contextlib.suppress(FileNotFoundError), _locked(file.parent) as over:  # its process may conclude it now
            study = _read(file.parent) if over else None
            if study is not None and not study.sent:
                found.append(study)
    return found


def _read(folder: Path) -> Unfinished | None:
    """Return what a folder says, None if it says nothing."""
    try:
        return Unfinished(folder, **json.loads((folder / _FILE).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{folder / _FILE} cannot be read: {error}; allowed: remove {folder}, the study begins anew"
        ) from error


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Hold the lock of a folder, which ends with its process; yields whether it is held."""
    with (folder / _LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
