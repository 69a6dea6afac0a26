"""Results of one design are made once, and never served for other numbers."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

import pytest
import torch

import torchmbd as mbd
from torchmbd.fem.reduction import cut, elimination
from torchmbd.fem.reduction.latest import BODIES, Latest

ONE = torch.ones(1, 3, dtype=torch.float64)


def test_equal_numbers_are_answered_once():
    latest, made = Latest[object](), []

    def result() -> object:
        made.append(object())
        return made[-1]

    first = latest("arm", (ONE,), result)
    assert latest("arm", (ONE.clone(),), result) is first
    assert latest("rod", (ONE,), result) is not first
    assert latest("arm", (2.0 * ONE,), result) is not first
    assert latest("arm", (ONE,), result) is not first  # the design before was replaced
    assert len(made) == 4


def test_numbers_that_change_in_place_are_other_numbers():
    latest, x = Latest[float](), ONE.clone()
    assert latest("arm", (x,), lambda: x.sum().item()) == 3.0
    x += 1.0
    assert latest("arm", (x,), lambda: x.sum().item()) == 6.0


def test_several_lanes_and_older_bodies_are_not_kept():
    latest, calls = Latest[None](), []
    for key in [*range(BODIES + 1), 0]:
        latest(key, (ONE,), lambda: calls.append(1))
    for _ in range(2):
        latest("lanes", (ONE.expand(2, 3),), lambda: calls.append(1))
    assert len(calls) == BODIES + 4


def test_threads_with_one_key_take_nothing_from_each_other():
    latest, others = Latest[int](), []

    class Interrupted(OrderedDict[Any, Any]):
        """Another thread asks where a result has just been put in."""

        def __setitem__(self, key: Any, x: Any) -> None:
            super().__setitem__(key, x)
            if not others:
                others.append(threading.Thread(target=latest, args=("arm", (2.0 * ONE,), lambda: 2)))
                others[0].start()
                others[0].join(0.05)

    latest._kept = Interrupted()
    assert latest("arm", (ONE,), lambda: 1) == 1
    others[0].join()


@pytest.mark.thorough
def test_a_body_and_its_first_motion_solve_for_modes_once(monkeypatch):
    solutions, factors = [], []
    solved, factorized = cut._cut_modes, elimination._factorized
    monkeypatch.setattr(cut, "_cut_modes", lambda *x: solutions.append(1) or solved(*x))
    monkeypatch.setattr(elimination, "_factorized", lambda *x: factors.append(1) or factorized(*x))
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45.0, -45.0]), 1e-3)
    mesh = mbd.mesh.rectangle(length=0.4, width=0.1, cells=(16, 4))
    arm = mbd.FlexibleBody.plate("arm", mesh, laminate, modes=3, position=(0.2, 0, 0))
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), arm.at("left"), axis="y")
    system = mbd.System([arm], [hinge], gravity=(0, 0, -9.81))
    energy = mbd.Integral(mbd.StrainEnergy("arm"))
    energy(mbd.simulate(system, 0.01, steps=4)).sum().backward()
    assert (len(solutions), len(factors)) == (1, 1)
    gradient = laminate.angles.grad.clone()
    with torch.no_grad():
        laminate.angles += 0.3
    laminate.angles.grad = None
    energy(mbd.simulate(system, 0.01, steps=4)).sum().backward()
    assert len(solutions) == 2
    assert not torch.allclose(laminate.angles.grad, gradient)
