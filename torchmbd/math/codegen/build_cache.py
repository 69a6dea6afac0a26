"""The folder of compiled code: what may be loaded from it, and how code gets there.

    code.so = what the compiler wrote + SEAL + SHA-256 of it

To load a library that was cut short ends the process by SIGBUS, and to load another's runs his code. So nothing is loaded
whose seal is wrong, or that another user can write. A file gets its name when it is on the disk as a whole.
The seal finds accidents, not forgery: against that stand the owner and the mode of the folder and of the file.
Checked in tests/math/codegen/test_build_cache.py.
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
WORK = "build-"  # what the folders of a build that is under way begin with
_OWN = re.compile(r"[a-z][a-z0-9_-]*-[0-9a-f]{32}\.so")
_OWN_FOLDER = re.compile(WORK + r"[a-z0-9_]{8}")
_PARTS = {"code.cpp", "code.so"}  # of such a folder
_said: set[str] = set()  # why something is not loaded


def refusal(path: Path) -> str | None:
    """Say why nothing is loaded from a folder, or a file, that is there; None where it is the user's own."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    if found.st_uid != os.geteuid():
        return f"{path} belongs to another user; allowed: your own"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"{path} can be written by others; allowed: by you alone (chmod go-w)"
    return None


def read(path: Path) -> bytes | None:
    """Return the code of a file; None if it is not there, not the user's (which is said), or broken and so removed."""
    if why := refusal(path.parent) or refusal(path):
        if why not in _said:
            warn(f"compiled code is not used: {why}")
        _said.add(why)
        return None
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    code, seal = data[: -len(SEAL) - 32], data[-len(SEAL) - 32 :]
    if seal == SEAL + hashlib.sha256(code).digest():
        return code
    remove(path, "is not what was built")
    return None


def remove(path: Path, why: str) -> None:
    """Remove what cannot be loaded, and say so: it is built again."""
    warn(f"compiled library {path} cannot be loaded and is removed: it {why}")
    path.unlink(missing_ok=True)


def keep(made: Path, to: Path) -> Path:
    """Seal what a compiler has made, and give it its name when the disk has it."""
    with made.open("r+b") as file:
        seal = SEAL + hashlib.sha256(file.read()).digest()
        file.write(seal)
        file.flush()
        os.fchmod(file.fileno(), 0o600)
        os.fsync(file.fileno())
    made.replace(to)
    folder = os.open(to.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return to


def entries() -> list[tuple[Path, int, bool]]:
    """What torchmbd has put into the folder: path, bytes, and whether it is a library."""
    folder = cache_folder()
    found = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir() and _OWN_FOLDER.fullmatch(path.name) and {f.name for f in path.iterdir()} <= _PARTS:
            found.append((path, sum(f.stat().st_size for f in path.iterdir()), False))
        elif path.is_file() and _OWN.fullmatch(path.name):
            found.append((path, path.stat().st_size, path.suffix in READY))
    return found


def clear() -> None:
    """Remove what `entries` lists, and nothing else."""
    for path, _, _ in entries():
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
