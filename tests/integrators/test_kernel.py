"""Steps by a kernel: its text as C++ gives the numbers of the eager march; NVRTC takes it, a CUDA device runs it."""

from __future__ import annotations

import ctypes
import pickle
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.integrators.test_compiled import weightless
from tests.integrators.test_device import CASES, CHECK, looks, motion, same  # noqa: F401
from tests.mechanisms import spoilt
from tests.stand_in import DEVICE, stand_in
from torchmbd.errors import MbdError
from torchmbd.integrators import compiled, kernel, library, repeated
from torchmbd.integrators.captured import placed_on
from torchmbd.integrators.code import source
from torchmbd.numerics import nvrtc
from torchmbd.system import Dynamics

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


class Here:
    """The kernels of a system as C++: threads one after another."""

    def __init__(self, dynamics: Dynamics, folder: Path):
        known = library.written_out(dynamics)
        assert known is not None
        T, layout, kind, sample, name = library.order(known.to(torch.device("cpu")), "kernel:here")
        text, made = folder / f"{name}.cpp", folder / f"{name}.so"
        if not made.exists():
            text.write_text(source(T, layout, kind, sample))
            subprocess.run(["g++", "-O0", "-std=c++17", "-shared", "-fPIC", "-o", str(made), str(text)], check=True)
        self.code = ctypes.CDLL(str(made))
        self.launched: list[str] = []

    def __call__(self, name: str, argument: Tensor, lanes: int) -> None:
        self.launched.append(name)
        for lane in range(lanes):
            self.code.lane(lane)
            getattr(self.code, name)(ctypes.c_void_p(argument.data_ptr()))


Used = list[Here]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kernels")


@pytest.fixture
def by_kernel(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Used]:
    """From now on marches are kernels', made for this machine."""
    used: Used = []

    def march(dynamics: Dynamics, w: Any, *arguments: Any) -> kernel.KernelMarch:
        used.append(Here(dynamics, folder))
        return kernel.KernelMarch(used[-1], dynamics, repeated.model(dynamics, w), *arguments)

    def begin() -> Used:
        monkeypatch.setattr(kernel, "CHECK", CHECK)
        monkeypatch.setattr(compiled, "march", march)
        monkeypatch.setattr(kernel, "march", march)
        return used

    return begin


@needs_compiler
@pytest.mark.parametrize(
    "name",
    [
        "slider-crank, three angles",
        "factors kept",
        "redundant constraints",
        "factors always",
        "contact and springs",
        "a law of the user's own",
        "drives with variables",
    ],
)
def test_the_numbers_of_the_eager_march(name: str, by_kernel: Callable[[], Used]) -> None:
    make, options = CASES[name]
    system = make()
    expected = motion(system, **options).require_ok()
    used = by_kernel()
    same(motion(system, **options), expected)
    assert used[0].launched.count("march") >= 3  # one for each look at least
    assert used[0].launched[0] == "room"


@needs_compiler
def test_on_a_stand_in_for_a_device(by_kernel: Callable[[], Used], monkeypatch: pytest.MonkeyPatch) -> None:
    """The host asks at looks only: for doubts, and for corrections."""
    make, options = CASES["drives with variables"]
    system = make()
    expected = motion(system, **options)
    used, asked = by_kernel(), []
    for steps in (2 * CHECK, 3 * CHECK):
        with stand_in(monkeypatch, graphs=False) as device:
            found = motion(system, device="meta", steps=steps, duration=steps * 0.0005, **options)
            torch.testing.assert_close(found.q, expected.q[:, : steps + 1], rtol=0, atol=1e-9)
        asked.append(device.asked.total())
    assert used[-1].launched.count("march") == 6
    assert asked[1] - asked[0] == 2


@needs_compiler
def test_one_correction_of_values(by_kernel: Callable[[], Used]) -> None:
    system = CASES["factors kept"][0]()
    options = {"iterations": (1, 1), "duration": 0.01}
    expected = motion(system, **options)
    by_kernel()
    same(motion(system, **options), expected)


@needs_compiler
def test_a_lane_that_fails_leaves_the_others_alone(
    by_kernel: Callable[[], Used], monkeypatch: pytest.MonkeyPatch
) -> None:
    system = CASES["slider-crank, three angles"][0]()
    spoilt(system, monkeypatch)
    expected = motion(system, duration=0.002)
    by_kernel()
    found = motion(system, duration=0.002)
    assert [status == "ok" for status in found.status] == [True, False, True]
    torch.testing.assert_close(found.q[[0, 2]], expected.q[[0, 2]], rtol=0, atol=1e-9)


@needs_compiler
def test_factors_that_cannot_be_relied_on_are_found_out(by_kernel: Callable[[], Used]) -> None:
    """A point mass: no inertia about any axis."""
    expected = motion(weightless(), sensitivities=False)
    used = by_kernel()
    found = motion(weightless(), sensitivities=False)
    assert used[0].launched == ["room", "doubts"]
    same(found, expected)


def test_nvrtc_compiles_the_text(tmp_path: Path) -> None:
    """For a device that need not be there."""
    try:
        nvrtc.library()
    except MbdError as error:
        pytest.skip(str(error))
    dynamics = CASES["drives with variables"][0]().dynamics()
    T, layout, kind, sample, _ = library.order(dynamics, "kernel:sm_90")
    nvrtc.compile_kernel(source(T, layout, kind, sample), "sm_90", tmp_path / "code.cubin")
    assert (tmp_path / "code.cubin").read_bytes().startswith(b"\x7fELF")
    with pytest.raises(MbdError, match=r"NVRTC fails with \d+: .*error"):
        nvrtc.compile_kernel("KERNEL nonsense", "sm_90", tmp_path / "code.cubin")


@needs_cuda
@pytest.mark.parametrize("name", ["slider-crank, three angles", "redundant constraints", "drives with variables"])
def test_on_a_device(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHMBD_CACHE", str(tmp_path))
    make, options = CASES[name]
    system = make()
    expected = motion(system, **options).require_ok()
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    made: list[Any] = []

    def at_once(dynamics: Dynamics) -> Any:
        major, minor = torch.cuda.get_device_capability()
        known = dynamics.to(torch.device("cpu"))
        if not library.path_of(known, f"kernel:sm_{major}{minor}").exists():
            library.build(*library.order(known, f"kernel:sm_{major}{minor}"))
        made.append(own(dynamics))
        return made[-1]

    own = kernel.kernels
    monkeypatch.setattr(kernel, "kernels", at_once)
    same(motion(system, device="cuda", **options), expected)
    assert made
    assert None not in made


def test_a_kernel_is_found_from_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the same key, and what has it built can be sent to another process."""
    dynamics = CASES["a law of the user's own"][0]().dynamics()
    known = library.written_out(dynamics)
    assert known is not None
    expected = library.order(known, "kernel:sm_90")
    with stand_in(monkeypatch):
        there = placed_on(dynamics, DEVICE)
        assert library.key(there, "kernel:sm_90") == expected[-1]
        found = library.order(there.to(torch.device("cpu")), "kernel:sm_90")
    assert found[-1] == expected[-1]
    assert pickle.loads(pickle.dumps(found))[1] == expected[1]
