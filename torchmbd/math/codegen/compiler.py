"""C++ on this machine: the compiler, the folder of shared libraries, and libraries of a fixed text.

A library is valid for one key: its source and all that it is made of, the versions of torch and Python, the compiler and
the processor. So a stale one is never found. What may be loaded says build_cache.py; without a C++ compiler torch serves,
said once.

Cache: TORCHMBD_CACHE or ~/.cache/torchmbd, which the user alone may write. TORCHMBD_COMPILE=0 switches compilation off;
CXX names the compiler, TORCHMBD_CXXFLAGS has more options for the code of mechanisms, as "-O0" or "-g".
Checked in tests/math/codegen/test_compiler.py.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import torch

from torchmbd.errors import warn
from torchmbd.math.codegen import build_cache
from torchmbd.process import cache_folder, require_cache_folder

SUFFIX = ".so"
OPTIONS = ("-std=c++17", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC")
PACKAGE = Path(__file__).parents[2]


def compiler() -> str:
    """The C++ compiler."""
    return os.environ.get("CXX", "g++")


def options() -> list[str]:
    """Options of the compiler for the code of mechanisms: the user's come last."""
    return ["-O2", *OPTIONS, *shlex.split(os.environ.get("TORCHMBD_CXXFLAGS", ""))]


def compilation_wanted() -> bool:
    """Whether compilation is not switched off."""
    return os.environ.get("TORCHMBD_COMPILE") != "0"


def unavailable() -> str | None:
    """Why nothing can be compiled or loaded here; None: it can."""
    if shutil.which(compiler()) is None:
        return f"there is no C++ compiler ({compiler()!r}, which CXX names); eager steps are about ten times slower in batches"
    return build_cache.refusal(cache_folder())


def toolchain_digest(sources: Iterable[str]) -> str:
    """Source files of the package (or folders of them), versions, compiler and processor, as a digest."""
    return _toolchain_digest(tuple(sources), compiler(), tuple(options()))


@cache
def _toolchain_digest(sources: tuple[str, ...], compiler: str, options: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for part in sources:
        path = PACKAGE / part
        for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    digest.update(repr([options, torch.__version__, sys.version_info[:2], version, _processor()]).encode())
    return digest.hexdigest()


def _processor() -> str:
    facts = Path("/proc/cpuinfo")
    if not facts.exists():
        return platform.processor() + platform.machine()
    lines = facts.read_text().splitlines()
    return repr(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))


def load(path: Path) -> ctypes.CDLL | None:
    """A library; None if it is not there, or removed because it cannot be loaded."""
    if build_cache.read(path) is None:
        return None
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        build_cache.remove(path, f"fails: {error}")
        return None


class Native:
    """The library of one file of the package, `source` relative to it; built when first asked for, once for a machine."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._loaded: ctypes.CDLL | None = None
        self._failed = False

    def __call__(self) -> ctypes.CDLL | None:
        """The library; None where it is not wanted, or cannot be made, which is said once."""
        if not compilation_wanted() or self._failed:
            return None
        if self._loaded is None:  # asked for in every product: no look at the disk
            self._loaded = self._made()
        return self._loaded

    def path(self) -> Path:
        """Where the library is, or would be."""
        return cache_folder() / f"{Path(self.source).stem}-{toolchain_digest([self.source])[:32]}{SUFFIX}"

    def _made(self) -> ctypes.CDLL | None:
        if (why := unavailable()) is not None:
            return self._fail(why)
        found = load(self.path())
        if found is None:
            try:
                self._build()
            except (OSError, subprocess.CalledProcessError) as error:
                return self._fail(str(error))
            found = load(self.path())
        return found

    def _build(self) -> None:
        """It appears complete or not at all."""
        with tempfile.TemporaryDirectory(prefix=build_cache.WORK, dir=require_cache_folder()) as work:
            made = Path(work) / "code.so"
            command = [compiler(), "-O3", *OPTIONS, "-o", str(made), str(PACKAGE / self.source)]
            subprocess.run(command, check=True, capture_output=True)
            build_cache.keep(made, self.path())

    def _fail(self, why: str) -> None:
        self._failed = True
        warn(f"{self.source} cannot be compiled, torch does its work more slowly: {why}")
