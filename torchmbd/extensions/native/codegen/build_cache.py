"""The folder of compiled code: which files may be loaded from it, and how files are written to it.

    code.so = output of the compiler + SEAL + SHA-256 of the output

Loading a truncated library ends the process by SIGBUS, and loading a library of another user runs his code. So no file is
loaded whose seal is wrong, or that another user can write. A file gets its name when it is completely on the disk.
The seal detects accidents, not forgery; the owner and the mode of folder and file protect against that.
Checked in tests/extensions/native/codegen/test_build_cache.py.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
from pathlib import Path

from torchmbd.errors import warn
from torchmbd.process import cache_folder

SEAL = b"torchmbd"
READY = (".so",)
WORK = "build-"  # prefix of folders of builds in progress
_LIBRARY = re.compile(r"[a-z][a-z0-9_-]*-[0-9a-f]{32}\.so")
_FOLDER = re.compile(WORK + r"[a-z0-9_]{8}")
_PARTS = {"code.cpp", "code.so"}  # files of such a folder
_warned: set[str] = set()  # reasons that a warning has given


def refusal(path: Path) -> str | None:
    """The reason why an existing folder or file is not used; None if only the user can write it, or it does not exist."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    if status.st_uid != os.geteuid():
        return f"{path} belongs to another user: must be your own"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"{path} can be written by others: must be writable by you alone. Try: chmod go-w"
    return None


def read_sealed(path: Path) -> bytes | None:
    """The code of a file; None if it does not exist, if others can write it (with a warning), or if it is broken (removed)."""
    if why := refusal(path.parent) or refusal(path):
        if why not in _warned:
            warn(f"compiled code is not used: {why}")
        _warned.add(why)
        return None
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    code, seal = data[: -len(SEAL) - 32], data[-len(SEAL) - 32 :]
    if seal == SEAL + hashlib.sha256(code).digest():
        return code
    remove_broken(path, "is not what was built")
    return None


def remove_broken(path: Path, why: str) -> None:
    """Remove a library that cannot be loaded, with a warning; it will be built again."""
    warn(f"compiled library {path} cannot be loaded and is removed: it {why}")
    path.unlink(missing_ok=True)


def seal_and_store(compiled: Path, to: Path) -> Path:
    """Add the seal to a compiled library, write it to the disk, then give it its name `to`."""
    with compiled.open("r+b") as file:
        seal = SEAL + hashlib.sha256(file.read()).digest()
        file.write(seal)
        file.flush()
        os.fchmod(file.fileno(), 0o600)
        os.fsync(file.fileno())
    compiled.replace(to)
    folder = os.open(to.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return to


def entries() -> list[tuple[Path, int, bool]]:
    """Files and folders of torchmbd in the folder: path, bytes, and whether it is a library."""
    folder = cache_folder()
    result = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir() and _FOLDER.fullmatch(path.name) and {f.name for f in path.iterdir()} <= _PARTS:
            result.append((path, sum(f.stat().st_size for f in path.iterdir()), False))
        elif path.is_file() and _LIBRARY.fullmatch(path.name):
            result.append((path, path.stat().st_size, path.suffix in READY))
    return result


def clear() -> None:
    """Remove the files and folders that `entries` lists."""
    for path, _, _ in entries():
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
