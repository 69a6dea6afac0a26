"""Steps that the adjoint makes again are the steps that were made, to the last digit."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from torchmbd.integrate.adjoint_solver import AdjointSolver, Grid

DURATION = 0.6


def pendulum() -> mbd.System:
    """Its spring is a variable, by which two lanes swing differently and pass an event at different times."""
    arm = mbd.RigidBody("arm", 1.0, (0.1, 0.1, 0.1), position=(0.3, 0.0, 0.0))
    hinge = mbd.Revolute(mbd.Ground().at(), arm.at(-0.3, 0.0, 0.0), axis="y", name="hinge")
    spring = mbd.SpringDamper(
        mbd.Ground().at(0.0, 0.0, 0.5), arm.at(), stiffness=mbd.variable(20.0), rest=0.4, name="spring"
    )
    return mbd.System([arm], [hinge], [spring], gravity=(0.0, 0.0, -9.81))


LOW = mbd.Event(mbd.Position("arm", "z") + 0.1, "falling")
PHASES = {
    "one segment": None,
    "events": [mbd.Phase(until=LOW), mbd.Phase()],
    "time": [mbd.Phase(until=0.137), mbd.Phase()],
}


@pytest.mark.thorough
@pytest.mark.parametrize("refresh", [1, 3])
@pytest.mark.parametrize("phases", PHASES)
def test_steps_from_checkpoints_lead_to_the_states_that_are_kept(phases, refresh, monkeypatch):
    equal = []

    class Solver(AdjointSolver):
        def __init__(self, grid: Grid):
            super().__init__(grid)
            for number, steps in enumerate(self.segments):
                row, beside = divmod(steps.stop - grid.offset, grid.every)
                if not beside:
                    end = self._history(number, self._schedule(steps))[0].at(slice(-1, None))
                    kept = grid.history.at(slice(row, row + 1))
                    equal.append(all(torch.equal(x, y) for x, y in zip(end.states, kept.states, strict=True)))

    monkeypatch.setattr("torchmbd.integrate.backend.AdjointSolver", Solver)
    designs = {"spring.stiffness": torch.tensor([20.0, 8.0], dtype=torch.float64, requires_grad=True)}
    options = {"steps": 60, "checkpoint": 10, "refresh": refresh, "backend": "eager", "phases": PHASES[phases]}
    motion = mbd.simulate(pendulum(), DURATION, designs=designs, **options).require_ok()
    motion.q[:, -1].sum().backward()
    assert equal
    assert all(equal)
