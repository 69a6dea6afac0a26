"""The C++ compiler of this machine, its options, and the library of a source file of the package.

The name of a library has a digest of its sources, the versions of torch and Python, the compiler and the processor, so an
outdated library is never loaded. build_cache.py decides which files may be loaded. Without a C++ compiler torch is used, with
one warning.

Cache: TORCHMBD_CACHE or ~/.cache/torchmbd, which only the user may write. TORCHMBD_COMPILE=0 switches compilation off;
CXX names the compiler, TORCHMBD_CXXFLAGS has more options for the code of mechanisms, as "-O0" or "-g".
Checked in tests/extensions/native/codegen/test_compiler.py.
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
from torchmbd.extensions.native.codegen import build_cache
from torchmbd.process import cache_folder, require_cache_folder
from torchmbd.progress import stage

SUFFIX = ".so"
OPTIONS = ("-std=c++17", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC")
PACKAGE = Path(__file__).parents[3]


def compiler() -> str:
    """The C++ compiler."""
    return os.environ.get("CXX", "g++")


def options(level: str = "-O2") -> list[str]:
    """Options of the compiler for the code of mechanisms, with a level of optimization: the user's come last."""
    return [level, *OPTIONS, *shlex.split(os.environ.get("TORCHMBD_CXXFLAGS", ""))]


def compilation_wanted() -> bool:
    """True if TORCHMBD_COMPILE does not switch compilation off."""
    return os.environ.get("TORCHMBD_COMPILE") != "0"


def unavailable() -> str | None:
    """The reason why code cannot be compiled or loaded here; None if it can."""
    if shutil.which(compiler()) is None:
        missing = f"a C++ compiler is not installed ({compiler()!r}, which CXX names)"
        return f"{missing}; eager steps are about ten times slower in batches"
    return build_cache.refusal(cache_folder())


def toolchain_digest(sources: Iterable[str]) -> str:
    """A digest of source files of the package (or folders of them), versions, compiler and processor."""
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
    """The library of a file; None if it does not exist, or cannot be loaded and was removed."""
    if build_cache.read_sealed(path) is None:
        return None
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        build_cache.remove_broken(path, f"fails: {error}")
        return None


class Native:
    """The library of a source file, named relative to the package; built at the first call, once for each machine."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._loaded: ctypes.CDLL | None = None
        self._failed = False

    def __call__(self) -> ctypes.CDLL | None:
        """The library; None if compilation is switched off, or fails, with one warning."""
        if not compilation_wanted() or self._failed:
            return None
        if self._loaded is None:  # called for every product, so the disk is not read again
            self._loaded = self._load_or_build()
        return self._loaded

    def path(self) -> Path:
        """Where the library is, or would be."""
        return cache_folder() / f"{Path(self.source).stem}-{toolchain_digest([self.source])[:32]}{SUFFIX}"

    def _load_or_build(self) -> ctypes.CDLL | None:
        if (why := unavailable()) is not None:
            return self._fail(why)
        library = load(self.path())
        if library is None:
            try:
                self._build()
            except (OSError, subprocess.CalledProcessError) as error:
                return self._fail(str(error))
            library = load(self.path())
        return library

    def _build(self) -> None:
        """Compile the source; the library gets its name when it is complete."""
        with (
            stage("compiling"),
            tempfile.TemporaryDirectory(prefix=build_cache.WORK, dir=require_cache_folder()) as work,
        ):
            output = Path(work) / "code.so"
            command = [compiler(), "-O3", *OPTIONS, "-o", str(output), str(PACKAGE / self.source)]
            subprocess.run(command, check=True, capture_output=True)
            build_cache.seal_and_store(output, self.path())

    def _fail(self, why: str) -> None:
        self._failed = True
        warn(f"{self.source} cannot be compiled, so slower operators of torch are used: {why}")
