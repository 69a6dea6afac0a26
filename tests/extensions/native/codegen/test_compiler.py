"""Libraries of fixed texts: built when asked for, their faults."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.refused import warned
from torchmbd.extensions.native.codegen.compiler import Native

SOURCE = "extensions/native/compiled_products.cpp"
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCHMBD_CACHE", str(tmp_path))
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    return tmp_path


@pytest.mark.thorough
@needs_compiler
def test_it_appears_complete_when_it_is_asked_for(cache: Path) -> None:
    native = Native(SOURCE)
    assert native() is not None
    assert list(cache.iterdir()) == [native.path()]
    assert Native(SOURCE)() is not None
    assert native() is native()


def test_switched_off(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHMBD_COMPILE", "0")
    assert Native(SOURCE)() is None
    assert list(cache.iterdir()) == []


def said_once(cache: Path, words: str) -> None:
    native = Native(SOURCE)
    with pytest.warns(UserWarning, match=words):
        assert native() is None
    assert native() is None  # neither said nor tried again
    assert list(cache.iterdir()) == []


def test_without_a_compiler(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    said_once(cache, r"a C\+\+ compiler is not installed")


def test_a_compiler_that_fails(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "false")
    said_once(cache, "compiled_products.cpp cannot be compiled.*false")


@pytest.mark.thorough
@needs_compiler
def test_a_corrupt_library_is_removed_and_built_again(cache: Path) -> None:
    native = Native(SOURCE)
    native.path().write_bytes(b"no library")
    with warned("cannot be loaded"):
        assert native() is not None


@needs_compiler
def test_a_full_disk_is_a_warning(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryDirectory", full)
    said_once(cache, "No space left on device")
