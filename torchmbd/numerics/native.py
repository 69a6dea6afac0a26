"""C++ on this machine: the compiler, the folder of shared libraries, and libraries of a fixed text.

A library is valid for one key: its source and all that it is made of, the versions of torch and Python, the compiler and
the processor. So a stale one is never found. What may be loaded says build_cache.py; without a C++ compiler torch serves,
said once.

Cache: TORCHMBD_CACHE or ~/.cache/torchmbd, which the user alone may write. TORCHMBD_COMPILE=0 switches compilation off;
CXX names the compiler.
Checked in tests/numerics/test_native.py.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import torch

from torchmbd.bare import command
from torchmbd.numerics import build_cache
from torchmbd.process import cache_folder, require_cache_folder

SUFFIX = ".so"
OPTIONS = ("-std=c++17", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC")
PACKAGE = Path(__file__).parent.parent


def compiler() -> str:
    """The C++ compiler."""
    return os.environ.get("CXX", "g++")


def wanted() -> bool:
    """Whether compilation is not switched off."""
    return os.environ.get("TORCHMBD_COMPILE") != "0"


def enabled() -> bool:
    """Whether compilation is wanted and a C++ compiler is there."""
    if not wanted():
        return False
    if shutil.which(compiler()) is None:
        warnings.warn("no C++ compiler: simulations run uncompiled, about ten times slower in batches", stacklevel=2)
    elif why := build_cache.refusal(cache_folder()):
        warnings.warn(f"compiled code is not used, simulations run about ten times slower: {why}", stacklevel=2)
    else:
        return True
    os.environ["TORCHMBD_COMPILE"] = "0"
    return False


def surroundings(sources: Iterable[str]) -> str:
    """Source files of the package (or folders of them), versions, compiler and processor, as a digest."""
    return _surroundings(tuple(sources), compiler())


@cache
def _surroundings(sources: tuple[str, ...], compiler: str) -> str:
    digest = hashlib.sha256()
    for part in sources:
        path = PACKAGE / part
        for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    digest.update(repr([OPTIONS, torch.__version__, sys.version_info[:2], version, _processor()]).encode())
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
    """The library of one file of the package, `source` relative to it; built in the background when first asked for."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._loaded: ctypes.CDLL | None = None
        self._build: subprocess.Popen | None = None
        self._failed = False

    def __call__(self) -> ctypes.CDLL | None:
        """The library if it is there and wanted."""
        if self._loaded is not None:  # asked for in every product: no look at the disk
            return self._loaded if wanted() else None
        if self._failed or not enabled():
            return None
        self._loaded = load(self.path())
        if self._build is None:
            if self._loaded is None:
                self._begin()
        elif self._loaded is not None:
            self._build.wait()  # it has nothing left to do
            self._build = None
        elif self._build.poll():
            self._fail(f"{compiler()} fails")
        return self._loaded

    def path(self) -> Path:
        """Where the library is, or would be."""
        return cache_folder() / f"{Path(self.source).stem}-{surroundings([self.source])[:32]}{SUFFIX}"

    def build(self) -> ctypes.CDLL | None:
        """The library, waited for."""
        if self() is None and self._build is not None:
            self._build.wait()
        return self()

    def _begin(self) -> None:
        part = self.path().with_suffix(f".{os.getpid()}.part")
        compile = [compiler(), "-O3", *OPTIONS, "-o", str(part), str(PACKAGE / self.source)]
        # It appears complete or not at all, also where this process has ended meanwhile.
        own = command("torchmbd.numerics.build_cache", str(part), str(self.path()), *compile)
        try:
            require_cache_folder()
            self._build = subprocess.Popen(
                own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            self._fail(str(error))

    def _fail(self, why: str) -> None:
        self._failed = True
        warnings.warn(f"{self.source} cannot be compiled, torch does its work more slowly: {why}", stacklevel=4)
