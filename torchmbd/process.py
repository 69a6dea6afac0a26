"""How a process of torchmbd uses the machine: its threads, the memory between two batches, and who goes first.

    settle        one thread: two make small batched solves 10 to 50 times slower. Memory that is freed stays with the
                  process: a batch of designs takes and frees hundreds of MB, and handing them back to the system and
                  asking for them again costs a sixth of its time, more where several workers ask at once.
                  torch's own Python code for tangents that are zero runs as it is: to keep torch.compile from looking
                  into it, torch would import torch._dynamo at its first call, half a second to a second of every process
    exempt        objects that imports and a first batch have left, half a million, are not searched for garbage again: each
                  search would take 0.2 to 3 s
    give_way      helpers beside a study (the writer, the studio) take what its computation leaves
    come_forward  ... until the study waits for them
    breed         starts a process that has imported what workers need, for them to be forked from: they begin at once, while
                  this one still does its own imports. Forked from this one they would copy its threads' locks

Memory: glibc's mallopt; elsewhere the allocator keeps its own habits. MEMORY are the same settings as an environment.
Priority: nice, which nothing takes back, and where Linux weighs whole sessions against each other (autogroup), theirs.
Checked in tests/test_process.py.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import inspect
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator
from functools import cache
from multiprocessing import forkserver
from pathlib import Path
from types import FunctionType

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
MEMORY = {"MALLOC_ARENA_MAX": "1", "MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": f"{2**31 - 1}"}
_MALLOPT = ((-8, 1), (-4, 0), (-1, 2**31 - 1))  # M_ARENA_MAX, M_MMAP_MAX, M_TRIM_THRESHOLD of malloc.h
_NICE = 5
BROOD = ("distributed", "torchmbd.experiment.farm", "torch.fx.experimental.symbolic_shapes")  # what workers import
_AUTOGROUP = Path("/proc/self/autogroup")


def cache_folder() -> Path:
    """Where a user's processes keep what serves them all: compiled libraries, the lock of new stores."""
    if given := os.environ.get("TORCHMBD_CACHE"):
        return Path(given)
    try:
        return Path.home() / ".cache" / "torchmbd"
    except RuntimeError:  # neither HOME nor an entry of the user's in the system, as in a container
        return Path(tempfile.gettempdir()) / f"torchmbd-{os.geteuid()}"


def require_cache_folder() -> Path:
    """Return this folder, made for the user alone where it is not there."""
    folder = cache_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


def settle() -> None:
    """Make this process fit for batches of small solves; torch's own threads included."""
    for name, count in ONE_THREAD.items():
        os.environ.setdefault(name, count)
    import torch

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    with contextlib.suppress(AttributeError, OSError):  # no glibc
        for parameter, value in _MALLOPT:
            ctypes.CDLL(None).mallopt(parameter, value)
    _leave_dynamo_out()


def _leave_dynamo_out() -> None:
    """Tell the wrappers of torch._refs (torch/_compile.py) that what they wrap needs no wrapper: here nothing is compiled."""
    import torch._compile
    import torch._refs

    for reference in list(vars(torch._refs).values()):
        while isinstance(reference, FunctionType):
            if reference.__code__.co_filename == torch._compile.__file__:
                plain = inspect.getclosurevars(reference).nonlocals["fn"]
                plain.__dynamo_disable = plain  # an attribute of a function: its name is not mangled
            reference = getattr(reference, "__wrapped__", None)


def breed(*modules: str) -> None:
    """Start the process that multiprocessing's "forkserver" forks from, with the modules imported; once is enough."""
    multiprocessing.set_forkserver_preload(list(modules))
    own = ONE_THREAD | MEMORY | {"PYTHONSAFEPATH": "1"}  # no module of the current folder hides one of Python's
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)
    try:
        with _children_deaf_to_interrupts():
            forkserver.ensure_running()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _children_deaf_to_interrupts() -> Iterator[None]:
    """Ctrl-C in the terminal reaches every process there: it is the study's to handle, not its workers'."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # what is ignored stays so in a new process
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@cache
def exempt() -> None:
    """Take what is there out of the garbage collector's sight; once, after the first batch."""
    gc.freeze()


def brief_warnings() -> None:
    """Say a warning in one line, without the code that gave it, and once: not again with other numbers."""
    said: set[str] = set()

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        kind = re.sub(r"\d[\d.e+-]*", "", str(message))
        if kind not in said:
            said.add(kind)
            print(f"warning: {message}", file=file or sys.stderr)

    warnings.showwarning = show


def give_way() -> None:
    """Let the processes of other sessions go first."""
    os.nice(_NICE)
    _weigh(_NICE)


def come_forward() -> None:
    """Take what `give_way` left to others, as far as the system allows."""
    _weigh(0)


def _weigh(nice: int) -> None:
    with contextlib.suppress(OSError):  # no such thing here, or asked too often
        _AUTOGROUP.write_text(str(nice))
