"""How a process of torchmbd uses the machine: threads, memory, a folder for what serves all processes, brief warnings.

An operator of torch uses one thread. Compiled code and modes of groups of designs (math/threads.py) share `thread_count()`
threads, and give the same bits with any number.
Checked in tests/test_process.py, tests/extensions/native/test_threads.py.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from torchmbd.errors import InputError

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of malloc.h for `mallopt`
_KEPT = 512 * 2**20  # bytes; 128 designs: 0.91 of the time with 512 MB, 0.95 with 256 MB, 1 with 128 MB
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
THREADS = "TORCHMBD_THREADS"
_CONTROL_GROUPS, _OF_PROCESS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_stated: list[int] = []  # the number of `threads`, if it was called


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


@contextmanager
def one_thread_of_blas() -> Iterator[None]:
    """Run operators of NumPy and SciPy in one thread inside, unless the environment states a number; restore it afterwards.

    A thread of OpenBLAS that has finished waits for its next call busily, for some 20 ms. During this time it takes its core
    from the threads of compiled code: a search of 32 starts on two cores takes 1.15 times as long.
    """
    if os.environ.keys() & ONE_THREAD.keys():
        yield
        return
    import scipy.linalg  # noqa: F401  which loads the BLAS of SciPy
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, "blas"):
        yield


@cache
def keep_freed_memory() -> bool:
    """Let this process keep up to 512 MB of freed memory for its next tensors; return whether its C library can.

    glibc gives each freed tensor of more than 32 MB back to the system, and the system fills the pages of the next one with
    zeros. On a virtual machine this is a third of what threads do not share in an evaluation of 128 designs. Settings of
    malloc in the environment have precedence.
    """
    if os.environ.keys() & {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"}:
        return False
    if not hasattr(os, "confstr") or "CS_GNU_LIBC_VERSION" not in os.confstr_names:
        return False  # mallopt of other C libraries has other meanings
    mallopt = ctypes.CDLL(None).mallopt
    return all([mallopt(_TRIM_THRESHOLD, _KEPT), mallopt(_MMAP_THRESHOLD, _KEPT)])


class threads:
    """Share the designs of a batch among `count` threads from now on, or only inside `with mbd.threads(count):`.

    count   1 or more; more threads than cores of this process are slower, with the same results

    Without `threads` the environment variable TORCHMBD_THREADS states the number. Without this variable it is the number of
    cores that this process may use. Workers have one thread unless TORCHMBD_THREADS is set. Results are bitwise identical for
    every number. Threads share steps of native code and their adjoint, and modes with their derivatives. Other operators of
    torch run in one thread, and so do steps if native code calls a law in Python. `motion.stats["threads"]` is the number of
    threads of the steps. Raises InputError unless `count` is a whole number, 1 or more.

    >>> with mbd.threads(2):
    ...     motion = mbd.simulate(mbd.examples.pendulum(), 0.1, steps=20)
    >>> motion.stats["threads"]  # a single design
    1
    """

    def __init__(self, count: int) -> None:
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InputError("threads", count, "an integer, 1 or more", hint=f"mbd.threads({cores()})")
        self._before = _stated[:]
        _stated[:] = [count]

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        _stated[:] = self._before


def thread_count() -> int:
    """Return the number of threads of compiled code; InputError if TORCHMBD_THREADS is not a positive integer."""
    if _stated:
        return _stated[0]
    if (text := os.environ.get(THREADS)) is None:
        return cores()
    if not (text.isascii() and text.isdigit() and int(text)):
        raise InputError(str(THREADS), text, "an integer, 1 or more", hint=f"{THREADS}={cores()}")
    return int(text)


def worker_threads() -> dict[str, str]:
    """Return the environment of workers, each of which has one thread unless the environment says otherwise."""
    return ONE_THREAD | {THREADS: os.environ.get(THREADS, "1")}


def cores() -> int:
    """Return the number of cores that this process may use, by its affinity and by the quota of its control groups."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, int(min(count, _least_quota())))


@cache
def _least_quota(of_process: Path = _OF_PROCESS, control_groups: Path = _CONTROL_GROUPS) -> float:
    """Return the least quota [cores] of the control groups of this process and of those around them; inf without one."""
    lines = of_process.read_text().splitlines() if of_process.is_file() else []
    return min([float("inf"), *map(_quota, _group_folders("cpu", lines, control_groups))])


def _group_folders(controller: str, lines: Iterable[str], control_groups: Path) -> list[Path]:
    """Return the folders of control groups that have a controller, and of those around them.

    lines  of /proc/self/cgroup, number:controllers:path; version 2 names no controllers
    """
    folders: dict[Path, None] = {}
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controller in controllers.split(",") or not controllers:
            root = control_groups / controller if controllers else control_groups
            bottom = root / path.lstrip("/")
            folders |= dict.fromkeys(x for x in (bottom, *bottom.parents) if x.is_relative_to(root))
    return list(folders)


def _quota(group: Path) -> float:
    """Return the quota [cores] of one control group, inf where it has none."""
    for names in (["cpu.max"], ["cpu.cfs_quota_us", "cpu.cfs_period_us"]):  # versions 2 and 1
        try:
            quota, period = " ".join((group / name).read_text() for name in names).split()
        except OSError:  # the other version, no such controller, or a group outside of this container
            continue
        if quota not in ("max", "-1"):
            return float(quota) / float(period)
    return float("inf")


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


def installed_memory() -> float:
    """Bytes of the machine, or of the container or job that this process runs in; inf where that is unknown."""
    try:
        machine = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not POSIX
        machine = math.inf
    return min([machine, *_control_group_limits(_OF_PROCESS, _CONTROL_GROUPS)])


@cache
def _control_group_limits(of_process: Path, control_groups: Path) -> list[float]:
    """Limits [bytes] of the control groups that this process is in, of versions 1 and 2, as in containers and SLURM jobs."""
    lines = of_process.read_text().splitlines() if os.access(of_process, os.R_OK) else []
    folders = _group_folders(
        "memory", ["0::/", "0:memory:/", *lines], control_groups
    )  # a container may see the root only
    files = [
        folder / name for folder in folders for name in ("memory.max", "memory.limit_in_bytes")
    ]  # of versions 2 and 1
    limits = [file.read_text().strip() for file in files if os.access(file, os.R_OK)]
    return [float(limit) for limit in limits if limit.isdigit()]


def available_memory() -> float:
    """Bytes that are free, and those that this process holds already: it uses them again."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        process_bytes = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux
        return installed_memory()
    # WSL 1 has no such line.
    free = [int(line.split()[1]) * 1024.0 for line in lines if line.startswith("MemAvailable:")]
    return min([x + process_bytes for x in free] + [installed_memory()])


def rounded_down(count: int) -> int:
    """Down to two figures: what is available changes from one moment to the next."""
    unit = 10 ** max(len(str(count)) - 2, 0)
    return count // unit * unit


def bytes_text(count: float) -> str:
    """Bytes in a fitting unit: `3.2 GB`."""
    power = min(max(int(math.log10(max(count, 1.0)) // 3), 2), 6)
    return f"{count / 1e3**power:.2g} {('MB', 'GB', 'TB', 'PB', 'EB')[power - 2]}"
