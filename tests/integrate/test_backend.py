"""Backends: the next one is one class and one entry, and without native code operators of torch serve."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import pytest
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import linked
from tests.refused import refused, warned
from torchmbd import registry
from torchmbd.integrate import backend
from torchmbd.integrate.backend import BACKENDS, Backend
from torchmbd.integrate.stepper import EagerStepper
from torchmbd.multibody.system.dynamics import Dynamics

PENDULUM = mbd.examples.pendulum()


class Counting(Backend):
    """The steps of operators of torch, counted; systems of two bodies it cannot serve."""

    steppers = 0

    def serves_auto(self) -> bool:
        return True

    def obstacle(self, dynamics: Dynamics, work: Sequence[str]) -> str | None:
        return "there are two bodies" if dynamics.topology.bodies == 2 else None

    def stepper(self, *arguments) -> EagerStepper:
        Counting.steppers += 1
        return super().stepper(*arguments)


def motion(system: mbd.System, name: str, **options) -> mbd.Trajectory:
    return mbd.simulate(system, 0.01, steps=4, backend=name, **options)


def without(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """As where the extension of this name is taken away."""
    monkeypatch.setattr(BACKENDS, "_entries", {key: kind for key, kind in BACKENDS.items() if key != name})
    installed = registry.find_spec
    monkeypatch.setattr(registry, "find_spec", lambda module: None if module.endswith(name) else installed(module))


def test_another_backend_is_one_class_and_one_entry(monkeypatch):
    monkeypatch.setattr(BACKENDS, "_entries", {"eager": Backend, "counting": Counting})
    monkeypatch.setattr(Counting, "steppers", 0)
    expected = motion(PENDULUM, "eager")
    for name in ("auto", "counting"):
        result = motion(PENDULUM, name)
        assert result.stats["backend"] == "counting"
        assert_close(result.q, expected.q, rtol=0, atol=0)
    assert expected.stats["backend"] == "eager"
    assert Counting.steppers == 2


def test_a_system_that_it_cannot_serve(monkeypatch):
    """By "auto" said once, by its name an error."""
    monkeypatch.setattr(BACKENDS, "_entries", {"eager": Backend, "counting": Counting})
    monkeypatch.setattr(backend, "_warned", set())
    system = linked(2)
    with warned("backend 'eager'", "two bodies"):
        assert motion(system, "auto", gradients="none").stats["backend"] == "eager"
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "steps are made")
        motion(system, "auto", gradients="none")
    with refused("backend", "counting"):
        motion(system, "counting", gradients="none")


def test_without_the_folder_eager_serves_and_native_is_refused(monkeypatch):
    without(monkeypatch, "native")
    monkeypatch.setattr(registry, "_tables", lambda: None)
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert motion(PENDULUM, "auto").stats["backend"] == "eager"
    with refused("backend", "native"):
        motion(PENDULUM, "native")


@pytest.mark.extensions  # the folder is there, native code is not
def test_without_native_code_it_is_refused_by_name(monkeypatch):
    without(monkeypatch, "native")
    with refused("backend", "native", "'auto' or 'eager'"):
        motion(PENDULUM, "native")
    with refused("backend", "cuda"):
        motion(PENDULUM, "cuda")


def test_no_name():
    with refused("backend", 3):
        motion(PENDULUM, 3)  # pyright: ignore[reportArgumentType]
