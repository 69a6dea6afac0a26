"""Compiled code on disk: keys, faults of the cache, which backend is chosen."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import linked, sprung
from tests.refused import refused, warned
from torchmbd.cli import main
from torchmbd.errors import InputError, MbdError
from torchmbd.examples.slider_crank import build
from torchmbd.extensions.native import library
from torchmbd.integrate import backend
from torchmbd.integrate.backend import with_backend
from torchmbd.multibody.forces.laws import Scaled
from torchmbd.multibody.system import Dynamics

ANGLES = mbd.deg([[30, -20, 50], [10, 40, -70], [-15, 80, 5]])
NAME = "rod.laminate.angles"
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCHMBD_CACHE", str(tmp_path))
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    for name in ("_loaded", "_failed"):
        monkeypatch.setattr(library, name, {})
    for module in (library, backend):
        monkeypatch.setattr(module, "_warned", set())
    return tmp_path


def dynamics(modes: int = 3, tangents: bool = True, layers: int = 3) -> Dynamics:
    system = build(layers, cells=(6, 2), modes=modes)
    return system.dynamics({NAME: ANGLES[:, :layers]}, tangents=[NAME] if tangents else []).condensed()


@pytest.mark.thorough
def test_a_key_covers_source_and_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    before = library.key(dynamics())
    monkeypatch.setattr(library, "toolchain_digest", lambda sources: "another source")
    assert library.key(dynamics()) != before


@pytest.mark.thorough
@needs_compiler
def test_a_corrupt_library_is_removed_and_built_again(cache: Path) -> None:
    d = with_backend(dynamics(modes=1), "eager")
    path = library.path_of(d)
    path.write_bytes(b"no library")
    with warned("cannot be loaded"):
        assert with_backend(d, "auto").backend == "native"
    assert path.stat().st_size > 1000


def test_the_command_lists_and_clears_what_is_its_own(cache: Path, capsys: pytest.CaptureFixture) -> None:
    name = f"step-{'0' * 32}"
    own = [cache / f"{name}.so"]
    others = [
        cache / "thesis" / "chapter.tex",
        cache / "notes.so",
        cache / "stores.lock",
        cache / "build-abcdefgh" / "x",
        cache / f"{name}.log",
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


@pytest.mark.thorough
@needs_compiler
def test_the_first_call_gives_the_numbers_of_the_tenth(cache: Path) -> None:
    """With an empty cache, a full one, and a library that is loaded: the same bits."""
    system = build(3, cells=(6, 2), modes=1)
    options = {"steps": 30, "designs": {NAME: ANGLES}, "gradients": "reverse"}

    def numbers() -> list[torch.Tensor]:
        motion = mbd.simulate(system, 0.001, **options)
        assert motion.stats["backend"] == "native"
        (slope,) = torch.autograd.grad(motion.q.square().sum(), motion.variables[NAME])
        return [motion.q.detach(), motion.lam.detach(), slope]

    first, second = numbers(), numbers()
    library._loaded.clear()
    assert library.cache_folder() == cache
    for x, y, z in zip(first, second, numbers(), strict=True):
        assert torch.equal(x, y)
        assert torch.equal(x, z)


@pytest.mark.thorough
def test_eager_and_switched_off(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert with_backend(dynamics(), "eager").backend == "eager"
    monkeypatch.setenv("TORCHMBD_COMPILE", "0")
    assert with_backend(dynamics(), "auto").backend == "eager"
    assert not list(cache.glob("step-*"))  # products of the structure stage have a library of their own


def test_a_backend_that_does_not_exist() -> None:
    with refused("backend", "cuda"):
        mbd.simulate(sprung(), 0.01, steps=2, backend="cuda")


def falls_back(d: Dynamics, words: str) -> None:
    """By `auto` said once, by `native` an error."""
    with pytest.warns(UserWarning, match=words):
        assert with_backend(d, "auto").backend == "eager"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert with_backend(d, "auto").backend == "eager"
    with pytest.raises(InputError, match=words):
        with_backend(d, "native")


@pytest.mark.thorough
def test_without_a_compiler(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    falls_back(dynamics(), r"a C\+\+ compiler is not installed")


@pytest.mark.thorough
@needs_compiler
def test_a_folder_that_others_can_write(cache: Path) -> None:
    cache.chmod(0o777)
    falls_back(dynamics(), "can be written by others")


@pytest.mark.thorough
def test_a_key_is_that_of_a_kind() -> None:
    """One library serves any number of bodies, modes and joints, but not another kind of joint."""
    assert len({library.key(dynamics(modes)) for modes in (1, 3, 4)}) == 1
    assert library.key(dynamics()) == library.key(dynamics(tangents=False)) == library.key(dynamics(layers=1))
    chains = [linked(n).dynamics() for n in (2, 3, 5)]
    assert len({library.key(d) for d in chains}) == 1
    assert library.key(chains[0]) not in (library.key(dynamics()), library.key(linked(2, mbd.Revolute).dynamics()))


def test_a_compiler_that_fails_is_reported(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "false")
    with pytest.raises(MbdError, match="false failed on the step of rod"):
        library.build("name", "step", "", "rod")
    assert list(cache.iterdir()) == []


@pytest.mark.thorough
def test_a_build_that_fails_is_said_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "false")
    falls_back(dynamics(modes=1), "false failed on the step of rod")
    assert list(cache.iterdir()) == []


@pytest.mark.thorough
def test_a_full_disk_is_a_warning(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryDirectory", full)
    falls_back(dynamics(modes=1), "No space left on device")


@pytest.mark.thorough
def test_a_law_of_the_user_is_in_the_key(cache: Path) -> None:
    """Two laws of one form have two libraries, whatever they take their numbers from."""
    held = {"stiffness": 3.0}

    def law(s: torch.Tensor, rate: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return -held["stiffness"] * torch.tanh(s)

    system, keys = sprung(law), []
    for stiffness in (3.0, 4.0, 3.0):
        held["stiffness"] = stiffness
        result = library.with_traced_laws(system().dynamics.condensed())
        keys.append(library.key(result))
    assert keys[0] == keys[2] != keys[1]


@pytest.mark.thorough
@needs_compiler
def test_a_varied_law_with_branches_in_python_stays_uncompiled(cache: Path) -> None:
    def law(s: torch.Tensor, rate: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return -s if float(s.sum()) > 0.0 else -2.0 * s

    falls_back(sprung(Scaled(mbd.variable(2.0), law)).dynamics(), "a law of a force cannot be compiled: .*tracing")
