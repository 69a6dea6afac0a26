# ruff: noqa: E402
"""What all tests share: one thread, no compilation, and a small slider-crank.

`--core` takes extensions away before anything of torchmbd is imported.
"""

from __future__ import annotations

import os
import shutil
import sys
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import settings


class NoExtensions(MetaPathFinder):
    """Python without torchmbd/extensions."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> None:
        if fullname.startswith("torchmbd.extensions"):
            raise ModuleNotFoundError(f"No module named {fullname!r}: --core", name=fullname)


if "--core" in sys.argv:
    os.environ["TORCHMBD_TESTS_OF_THE_CORE"] = "1"  # for workers of pytest-xdist
CORE = "TORCHMBD_TESTS_OF_THE_CORE" in os.environ
if CORE:
    sys.meta_path.insert(0, NoExtensions())
collect_ignore = ["extensions"] if CORE else []

import torchmbd as mbd
from torchmbd.examples.slider_crank import build
from torchmbd.integrate import Trajectory
from torchmbd.integrate.backend import BACKENDS
from torchmbd.math.products import compiled_products
from torchmbd.tracking.store import open_store

# Tests run by operators of torch, the reference; tests of compilation switch it on themselves.
os.environ["TORCHMBD_COMPILE"] = "0"
# Code of small tests: to compile it with -O2 takes longer than to run it as it is.
os.environ.setdefault("TORCHMBD_CXXFLAGS", "-O0")
if "PYTEST_XDIST_WORKER" in os.environ:  # each worker has a core
    os.environ.setdefault("TORCHMBD_THREADS", "1")
torch.set_num_threads(1)
ROOT = Path(__file__).parent
SECOND_TIER = {"contracts", "experiments"}  # folders whose tests CI runs; in the default suite they are not


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--native`: the same tests by native code wherever production uses it. `--core`: those of the core alone."""
    parser.addoption("--native", action="store_true", help="native code wherever production uses it")
    parser.addoption(
        "--core", action="store_true", help="without torchmbd/extensions: imports fail, their tests are left out"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Before anything is built."""
    if config.getoption("--native"):
        os.environ["TORCHMBD_COMPILE"] = "1"
        os.environ["TORCHMBD_CXXFLAGS"] = ""


def _needs_extensions(item: pytest.Item) -> bool:
    """Marked so, or a case that names the backend of compiled code."""
    parameters = getattr(getattr(item, "callspec", None), "params", {}).values()
    named = any(isinstance(value, str) and value == "native" for value in parameters)
    return named or item.get_closest_marker("extensions") is not None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`@pytest.mark.thorough("a", "b")` marks the cases "a", "a-...", "...-b" of a test; without names all of them.

    All tests of contracts and experiments are thorough.
    """
    if CORE:
        items[:] = [item for item in items if not _needs_extensions(item)]
    for item in items:
        if SECOND_TIER & {*item.path.relative_to(ROOT).parts}:
            item.add_marker(pytest.mark.thorough)
        own = item.own_markers
        for mark in [m for m in own if m.name == "thorough" and m.args]:
            case = f"-{item.name.partition('[')[2][:-1]}-"
            if not any(f"-{name}-" in case for name in mark.args):
                own.remove(mark)


settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def store(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Evaluations and journals of studies that a test runs go into a folder of their own."""
    os.environ["TORCHMBD_STORE"] = str(tmp_path_factory.mktemp("torchmbd"))


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tracking store without runs, to be copied: MLflow takes five seconds to make one."""
    file = tmp_path_factory.mktemp("empty") / "runs.db"
    open_store(f"sqlite:///{file}")
    return file


@pytest.fixture(scope="session", autouse=True)
def library(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The cache of compiled code of this run, for all processes of pytest-xdist: what one has built the others load."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base) / "libraries"
    folder.mkdir(mode=0o700, exist_ok=True)
    os.environ["TORCHMBD_CACHE"] = str(folder)
    return str(folder)


@pytest.fixture(scope="session")
def native() -> None:
    """There is native code, and a C++ compiler: `backend="native"` serves."""
    if "native" not in BACKENDS:
        pytest.skip("no native code")
    if shutil.which(os.environ.get("CXX", "g++")) is None:
        pytest.skip("no C++ compiler")


@pytest.fixture
def compiled(native: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps and products are compiled code wherever production uses it."""
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    assert compiled_products(torch.zeros(1)) is not None


@pytest.fixture(params=["torch", "compiled"])
def products(request: pytest.FixtureRequest) -> None:
    """A test runs with products of torch and with compiled ones."""
    if request.param == "compiled":
        request.getfixturevalue("compiled")


ANGLES = (30.0, -20.0, 50.0)


@pytest.fixture(scope="session")
def slider_crank() -> mbd.System:
    """The slider-crank with a coarse rod and three modes, in a general lay-up."""
    return build(3, ANGLES, cells=(6, 2), modes=3)


@pytest.fixture(scope="session")
def slider_crank_motion(slider_crank: mbd.System) -> Trajectory:
    """A short motion of it with sensitivities, its discrete map solved to rounding."""
    return mbd.simulate(slider_crank, 0.004, steps=80, gradients="forward", iterations=(6, 6), refresh=1)
