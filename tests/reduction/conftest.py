"""Both ways to multiply: torch, and compiled code."""

from __future__ import annotations

import shutil

import pytest

from torchmbd.numerics.native import compiler
from torchmbd.reduction import panels


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder of its own for the compiled products, which are built once."""
    return str(tmp_path_factory.mktemp("libraries"))


@pytest.fixture
def compiled(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Products are compiled code."""
    monkeypatch.setenv("TORCHMBD_CACHE", library)
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    if shutil.which(compiler()) is None:
        pytest.skip("no C++ compiler")
    assert panels._native() is not None


@pytest.fixture(params=["torch", "compiled"])
def products(request: pytest.FixtureRequest) -> None:
    """A test runs with products of torch and with compiled ones."""
    if request.param == "compiled":
        request.getfixturevalue("compiled")
