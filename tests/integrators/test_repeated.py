"""Steps of recorded operations against steps as they are written: the same numbers."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.integrators.test_phases import pushed
from tests.mechanisms import pendulum, rigid_pendulum, soft_slider_crank, sprung
from tests.sensitivity.test_law_variables import arm
from tests.system.test_initial import four_bar
from torchmbd.integrators import repeated
from torchmbd.integrators.generalized_alpha import initial
from torchmbd.integrators.march import March
from torchmbd.integrators.step import Coefficients, Model

ANGLES = "rod.laminate.angles"
PHASES = [mbd.Phase(until=0.0233), mbd.Phase(release=["motor"])]
CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "values": (pendulum, {}),
    "gradients": (pendulum, {"sensitivities": True}),
    "no flexible body": (rigid_pendulum, {}),
    "condensed": (soft_slider_crank, {"sensitivities": True, "iterations": (2, 2)}),
    "factors kept": (soft_slider_crank, {"refresh": 3}),
    "factors always": (four_bar, {"refresh": 0}),
    "one correction": (soft_slider_crank, {"iterations": (1, 1)}),
    "forces": (lambda: sprung(mbd.forces.Spring(2.0, 0.1)), {"sensitivities": True}),
    "drives with variables": (arm, {"sensitivities": True}),
    "phases": (lambda: pushed(0.7), {"phases": PHASES}),
}


@pytest.fixture(autouse=True)
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHMBD_COMPILE", "0")


def as_written(dynamics: Any, w: Any) -> Model:
    return Model(dynamics.topology, dynamics.saddle, w, dynamics.data)


@pytest.mark.parametrize("name", CASES)
def test_the_same_numbers(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make, options = CASES[name]
    system, designs = make(), {}
    if ANGLES in dict(system.named_parameters()):
        own = system.body("rod").laminate.angles.detach()
        designs = {"designs": {ANGLES: own + torch.tensor([[0.0], [0.3]], dtype=torch.float64)}}
    used: list[Model] = []
    monkeypatch.setattr(repeated, "RepeatedStep", _seen(repeated.RepeatedStep, used))
    found = mbd.simulate(system, 0.04, steps=40, **designs, **options).require_ok()
    assert used
    monkeypatch.setattr(repeated, "model", as_written)
    expected = mbd.simulate(system, 0.04, steps=40, **designs, **options)
    for mine, other in ((found.q, expected.q), (found.v, expected.v), (found.a, expected.a)):
        assert_close(mine, other, rtol=1e-12, atol=1e-12)
    if "sensitivities" in options:
        largest = float(expected.dq_db.abs().max())
        assert_close(found.dq_db, expected.dq_db, rtol=0, atol=1e-11 * largest)


def _seen(kind: Any, used: list[Any]) -> Any:
    def made(*arguments: Any) -> Any:
        used.append(kind(*arguments))
        return used[-1]

    return made


def test_a_law_of_the_user_may_branch() -> None:
    """Only steps as they are written do what it does."""

    def law(s: torch.Tensor, rate: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return -2.0 * s if float(t) < 0.02 else -50.0 * s

    w = Coefficients(0.9).weights(1e-3)
    assert type(repeated.model(sprung(law).dynamics(), w)) is Model
    assert type(repeated.model(sprung(mbd.forces.Spring(2.0, 0.1)).dynamics(), w)) is repeated.RepeatedModel


def test_the_state_of_a_step_is_the_callers_own() -> None:
    system = pendulum()
    dynamics = system.dynamics({ANGLES: system.body("rod").laminate.angles.detach()[None]}, tangents=[ANGLES])
    h = 1e-3
    march = March(dynamics, repeated.model(dynamics, Coefficients(0.9).weights(h)), (3, 1), 1)
    schedule = dynamics.topology.schedule(h * torch.arange(1, 8, dtype=torch.float64), dynamics.data)
    states, copies = [initial(dynamics)], []
    for i, given in enumerate(schedule):
        states.append(march(i, states[-1], given))
        copies.append([x.full.clone() for x in states[-1]])
    for state, copy in zip(states[1:], copies, strict=True):
        assert all(torch.equal(x.full, y) for x, y in zip(state, copy, strict=True))
