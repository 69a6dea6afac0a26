"""Compiled code on disk: keys, faults of the cache, when it is built."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import torch

import torchmbd as mbd
from experiments.slider_crank import build
from tests.mechanisms import sprung
from torchmbd.cli import main
from torchmbd.errors import MbdError
from torchmbd.integrators import library
from torchmbd.system import Dynamics

ANGLES = mbd.deg([[30, -20, 50], [10, 40, -70], [-15, 80, 5]])
NAME = "rod.laminate.angles"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCHMBD_CACHE", str(tmp_path))
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    for name in ("_loaded", "_seen", "_building"):
        monkeypatch.setattr(library, name, {})
    return tmp_path


def dynamics(modes: int = 3, tangents: bool = True, layers: int = 3) -> Dynamics:
    system = build(layers, cells=(6, 2), modes=modes)
    return system.dynamics({NAME: ANGLES[:, :layers]}, tangents=[NAME] if tangents else []).condensed()


def test_a_key_is_that_of_a_topology() -> None:
    """One library serves any number of variables and lanes."""
    keys = [library.key(dynamics(modes)) for modes in (3, 4)]
    assert len(set(keys)) == 2
    assert (
        keys[0] == library.key(dynamics()) == library.key(dynamics(tangents=False)) == library.key(dynamics(layers=1))
    )


def test_a_key_covers_source_and_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    before = library.key(dynamics())
    monkeypatch.setattr(library, "surroundings", lambda sources: "another source")
    assert library.key(dynamics()) != before


def test_a_corrupt_library_is_removed_and_the_eager_route_serves(cache: Path) -> None:
    d = dynamics()
    library.path_of(d).write_bytes(b"no library")
    with pytest.warns(UserWarning, match="cannot be loaded and is removed"):
        assert library.library(d) is None
    assert list(cache.iterdir()) == []


def test_the_command_lists_and_clears_what_is_its_own(cache: Path, capsys: pytest.CaptureFixture) -> None:
    name = f"step-{'0' * 32}"
    own = [cache / f"{name}{end}" for end in (".so", ".log", ".123.part")]
    others = [
        cache / "thesis" / "chapter.tex",
        cache / "notes.so",
        cache / "stores.lock",
        cache / "build-abcdefgh" / "x",
    ]
    begun = cache / "build-0123abc_" / "code.cpp"
    for file in (*own, *others, begun):
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"x")
    assert main(["cache"]) == 0
    text = capsys.readouterr().out
    assert f"{name}.so" in text
    assert "left over" in text
    assert "thesis" not in text
    assert main(["cache", "--clear"]) == 0
    assert not begun.parent.exists()
    assert [file for file in own if file.exists()] == []
    assert [file for file in others if not file.exists()] == []


def test_a_library_is_built_at_the_second_batch_only(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[Dynamics] = []

    def build(d: Dynamics, kind: str) -> None:
        built.append(d)
        library._building[library.key(d)] = None

    monkeypatch.setattr(library, "build_in_background", build)
    counts = []
    for _ in range(4):
        assert library.library(dynamics()) is None
        counts.append(len(built))
    assert counts == [0, 1, 1, 1]


def test_without_a_compiler_the_eager_route_works_and_says_so(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(UserWarning, match=r"no C\+\+ compiler"):
        assert library.library(dynamics()) is None


def test_a_compiler_that_fails_is_told(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "false")
    with pytest.raises(MbdError, match="false failed on the step of rod"):
        library.build(*library.order(dynamics(modes=1)))
    assert list(cache.iterdir()) == []


def test_a_build_that_fails_in_the_background_is_told_once(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """In a folder with a random.py, which is the user's affair and not executed."""
    folder = tmp_path_factory.mktemp("current")
    (folder / "random.py").write_text("open('proof', 'w')")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("CXX", "false")
    d = dynamics(modes=1)
    process = library.build_in_background(d)
    assert process is not None
    assert process.wait() == 1
    assert not (folder / "proof").exists()
    with pytest.warns(UserWarning, match="the build of compiled code failed"):
        assert library.library(d) is None
    (log,) = cache.iterdir()  # and no job, which another could have changed
    assert "false failed on the step of rod" in log.read_text()
    assert library.library(d) is None  # neither said nor tried again
    assert list(cache.iterdir()) == [log]


def test_a_full_disk_is_a_warning(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    with pytest.warns(UserWarning, match="nothing can be compiled"):
        assert library.build_in_background(dynamics(modes=1)) is None


def test_a_law_of_the_user_is_in_the_key(cache: Path) -> None:
    """Two laws of one form have two libraries, whatever they take their numbers from."""
    held = {"stiffness": 3.0}

    def law(s: torch.Tensor, rate: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return -held["stiffness"] * torch.tanh(s)

    system, keys = sprung(law), []
    for stiffness in (3.0, 4.0, 3.0):
        held["stiffness"] = stiffness
        found = library.written_out(system().condensed())
        assert found is not None
        keys.append(library.key(found))
    assert keys[0] == keys[2] != keys[1]


def test_a_law_with_branches_in_python_stays_uncompiled(cache: Path) -> None:
    def law(s: torch.Tensor, rate: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return -s if float(s.sum()) > 0.0 else -2.0 * s

    library._told.clear()
    with pytest.warns(UserWarning, match="a law of a force cannot be compiled, simulations run uncompiled: .*tracing"):
        assert library.written_out(sprung(law)().condensed()) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        assert library.library(sprung(law)().condensed()) is None
