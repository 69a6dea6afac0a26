"""How a process of torchmbd uses the machine: one thread, a folder for what serves all processes, brief warnings.

Checked in tests/test_process.py.
"""

from __future__ import annotations

import gc
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def cache_folder() -> Path:
    """Where a user's processes keep what serves them all: compiled libraries, the lock of new stores."""
    if folder := os.environ.get("TORCHMBD_CACHE"):
        return Path(folder)
    try:
        return Path.home() / ".cache" / "torchmbd"
    except RuntimeError:  # neither HOME nor an entry of the user's in the system, as in a container
        return Path(tempfile.gettempdir()) / f"torchmbd-{os.geteuid()}"


def require_cache_folder() -> Path:
    """Return this folder, made for the user alone where it is not there."""
    folder = cache_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


@contextmanager
def imports() -> Iterator[None]:
    """Import modules inside without collecting garbage, of which they have none: to look for it takes a sixth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def use_one_thread() -> None:
    """Give torch one thread, unless the environment says otherwise: two make small batched solves 10 to 50 times slower."""
    for name, count in ONE_THREAD.items():
        os.environ.setdefault(name, count)
    import torch

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))


@contextmanager
def one_thread() -> Iterator[None]:
    """Run operators of torch in one thread inside, unless OMP_NUM_THREADS states a number; then restore the number before."""
    import torch

    count = torch.get_num_threads()
    if count == 1 or "OMP_NUM_THREADS" in os.environ:
        yield
        return
    torch.set_num_threads(1)  # takes less than a microsecond
    try:
        yield
    finally:
        torch.set_num_threads(count)


def brief_warnings() -> None:
    """Say a warning in one line, without the code that gave it, and once: not again with other numbers."""
    shown: set[str] = set()

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        kind = re.sub(r"\d[\d.e+-]*", "", str(message))
        if kind not in shown:
            shown.add(kind)
            print(f"warning: {message}", file=file or sys.stderr)

    warnings.showwarning = show


def utf8(text: str) -> str:
    """Return a name of a file as UTF-8 reads it, where the locale has another encoding (POSIX: ASCII)."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def file_of(text: str) -> Path:
    """Return the path of a file whose name is written in UTF-8, in the encoding of the locale."""
    return Path(os.fsdecode(text.encode("utf-8", "surrogateescape")))
