"""The folder of compiled code: a library that is cut, or another user's, is not loaded, and never ends a process."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from tests.refused import warned
from torchmbd.extensions.native.codegen import build_cache, compiler
from torchmbd.process import cache_folder, require_cache_folder

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCHMBD_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    monkeypatch.setattr(build_cache, "_warned", set())
    return require_cache_folder()


def compiled(folder: Path) -> Path:
    """A library of a page and more, as the compiler leaves it."""
    text, result = folder / "code.cpp", folder / "code.so"
    text.write_text('extern "C" { double table[4096] = {1.0}; double first() { return table[0]; } }')
    subprocess.run([compiler.compiler(), "-shared", "-fPIC", "-o", str(result), str(text)], check=True)
    text.unlink()
    return result


LOAD = (
    "import sys, warnings; warnings.simplefilter('always')\n"
    "from pathlib import Path\n"
    "from torchmbd.extensions.native.codegen.compiler import load\n"
    "for name in sys.argv[1:]:\n"
    "    found = load(Path(name))\n"
    "    print('nothing' if found is None else found.first())"
)


@pytest.mark.thorough
@needs_compiler
def test_a_library_that_was_cut_ends_no_process(folder: Path) -> None:
    """Loaded, it is a SIGBUS: at the first look at a page that the file does not have."""
    whole = build_cache.seal_and_store(compiled(folder), folder / f"step-{'0' * 32}.so")
    data = whole.read_bytes()
    files = [folder / f"step-{k:032d}.so" for k in range(1, 7)]
    for share, file in zip((0.0, 0.1, 0.3, 0.6, 0.9, 1.0), files, strict=True):
        file.write_bytes(data[: int(share * len(data)) - (share == 1.0)])
    command = [sys.executable, "-c", LOAD, *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["nothing"] * 6
    assert done.stderr.count("cannot be loaded and is removed") == 6
    assert list(folder.iterdir()) == [whole]


@needs_compiler
def test_what_was_kept_is_loaded(folder: Path) -> None:
    file = build_cache.seal_and_store(compiled(folder), folder / f"step-{'0' * 32}.so")
    assert list(folder.iterdir()) == [file]
    code = compiler.load(file)
    assert code is not None
    code.first.restype = ctypes.c_double
    assert code.first() == 1.0
    assert file.stat().st_mode & 0o777 == 0o600


@needs_compiler
def test_a_library_from_elsewhere_is_not_loaded(folder: Path) -> None:
    """One that works, but that torchmbd has not built."""
    with warned("is not what was built"):
        assert compiler.load(compiled(folder)) is None


@pytest.mark.parametrize(("target", "mode"), [("folder", 0o777), ("folder", 0o770), ("file", 0o666), ("file", 0o620)])
def test_what_others_can_write_is_refused_once(folder: Path, target: str, mode: int) -> None:
    made = folder / "made"
    made.write_bytes(b"code")
    file = build_cache.seal_and_store(made, folder / f"step-{'0' * 32}.so")
    assert build_cache.read_sealed(file) == b"code"
    (folder if target == "folder" else file).chmod(mode)
    with warned("written by others"):
        assert build_cache.read_sealed(file) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert build_cache.read_sealed(file) is None
    assert file.exists()


def test_what_another_user_owns_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = folder / "made"
    made.write_bytes(b"code")
    file = build_cache.seal_and_store(made, folder / f"step-{'0' * 32}.so")
    own = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: own + 1)
    with warned("another user"):
        assert build_cache.read_sealed(file) is None


def test_nothing_is_built_where_others_can_write(folder: Path) -> None:
    folder.chmod(0o777)
    assert "can be written by others" in str(compiler.unavailable())
    library = compiler.Native("extensions/native/compiled_products.cpp")
    with warned("written by others"):
        assert library() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        assert library() is None
    assert list(folder.iterdir()) == []


def test_the_folder_is_made_for_the_user_alone(folder: Path) -> None:
    assert folder.stat().st_mode & 0o777 == 0o700


def test_the_disk_has_a_file_before_it_has_its_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a power cut a name without its bytes would be a library that is cut."""
    done: list[object] = []
    made, to = folder / "made", folder / "named"
    made.write_bytes(b"code")
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        done.append((os.path.realpath(f"/proc/self/fd/{descriptor}"), to.exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    build_cache.seal_and_store(made, to)
    assert done == [(str(made), False), (str(folder), True)]


def test_a_user_without_a_home_has_a_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("TORCHMBD_CACHE", raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    assert cache_folder().name == f"torchmbd-{os.geteuid()}"
