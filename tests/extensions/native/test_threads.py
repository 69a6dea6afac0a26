"""Threads of compiled code: the same bits with any number of them, failures as with one, laws of Python in the caller's."""

from __future__ import annotations

import threading
from collections.abc import Callable
from importlib import import_module

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.extensions.native.test_feedback import branching, sprung
from tests.mechanisms import pendulum, spoilt
from torchmbd.examples.slider_crank import build
from torchmbd.math import threads

ROD = "rod.laminate.angles"
ANGLES = mbd.deg([30, -20, 50]) + torch.linspace(0.0, 0.5, 11, dtype=torch.float64)[:, None]  # three blocks
COUNTS = (1, 2, 3)


@pytest.fixture
def team(compiled: None, monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """Compiled code on threads, also where a batch is small; the sizes of the teams that worked."""
    sizes: set[int] = set()
    real = threads.run_blocks

    def counted(run: Callable, blocks: int, count: int | None = None, scratch: int = 0) -> int:
        workers: set[int] = set()

        def noted(*piece: int) -> int | None:
            workers.add(threading.get_ident())
            return run(*piece)

        status = real(noted, blocks, count, scratch)
        sizes.add(len(workers))
        return status

    for name in ("steps", "backward", "compiled_products"):
        module = import_module(f"torchmbd.extensions.native.{name}")
        monkeypatch.setattr(module, "run_blocks", counted)
        monkeypatch.setattr(module, "SMALL", 0, raising=False)
    return sizes


def with_each_count(run: Callable[[], list[Tensor]]) -> None:
    """The results of `run` have the same bits with each number of threads."""
    results = []
    for count in COUNTS:
        with mbd.threads(count):
            results.append([x.detach().numpy().tobytes() for x in run()])
    assert results[0]
    assert results[1] == results[0]
    assert results[2] == results[0]


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["forward", "reverse"])
def test_motions_and_gradients(team: set[int], gradients: str) -> None:
    system = build(3, cells=(6, 2), modes=3)

    def run() -> list[Tensor]:
        angles = ANGLES.clone().requires_grad_()
        motion = mbd.simulate(system, 0.002, steps=30, gradients=gradients, designs={ROD: angles}).require_ok()
        assert motion.stats["threads"] == threads.thread_count()
        return [motion.q, motion.lam, *torch.autograd.grad((motion.q * (1.0 + motion.q)).sum(), angles)]

    with_each_count(run)
    assert max(team) > 1


@pytest.mark.thorough
def test_phases_of_lanes_that_switch_at_their_own_times(team: set[int]) -> None:
    system = pendulum(damping=1e-4)
    designs = mbd.deg([20.0, -50.0]) + torch.linspace(0.0, 0.5, 9, dtype=torch.float64)[:, None]
    event = mbd.Event(lambda motion: motion.body("rod").at("right").position[..., 2] + 0.0155, "falling")
    phases = [mbd.Phase(until=event), mbd.Phase(lock=["universal_arm_rod"])]

    def run() -> list[Tensor]:
        angles = designs.clone().requires_grad_()
        motion = mbd.simulate(system, 0.05, steps=25, designs={ROD: angles}, phases=phases).require_ok()
        return [motion.q, motion.switches[0].t, *torch.autograd.grad(motion.q.square().sum(), angles)]

    with_each_count(run)
    assert max(team) > 1


@pytest.mark.thorough
def test_a_lane_that_fails_and_those_that_do_not(team: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
    system, statuses = build(3, cells=(6, 2), modes=3), []
    spoilt(system, monkeypatch, lane=5)

    def run() -> list[Tensor]:
        motion = mbd.simulate(system, 0.001, steps=15, designs={ROD: ANGLES}, gradients="forward")
        statuses.append(motion.status)
        assert motion.dq_db is not None
        return [motion.q, motion.dq_db]

    with_each_count(run)
    assert [x == "ok" for x in statuses[0]] == [lane != 5 for lane in range(len(ANGLES))]
    assert statuses[1:] == statuses[:-1]


@pytest.mark.thorough
def test_laws_of_python_are_called_in_the_thread_of_the_caller(native: None) -> None:
    callers = set()

    def law(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        callers.add(threading.get_ident())
        return branching(s, rate, t)

    system = sprung(law)
    name = next(key for key, x in system.named_parameters() if key.startswith("controller") and x.numel() == 1)
    x = torch.linspace(0.0, 0.2, 11, dtype=torch.float64).requires_grad_()

    def run() -> list[Tensor]:
        motion = mbd.simulate(system, 0.02, steps=8, designs={name: x[:, None]}, backend="native").require_ok()
        assert motion.stats["threads"] == 1
        return [motion.q, *torch.autograd.grad(motion.q.square().sum(), x)]

    with_each_count(run)
    assert callers == {threading.get_ident()}
