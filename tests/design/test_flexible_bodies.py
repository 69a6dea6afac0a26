"""The bodies of a design: a result has those of its best design, and the system of its problem keeps its numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from torchmbd.design.flexible_bodies import flexible_bodies
from torchmbd.optimization.multistart import MultistartResult


def problem() -> mbd.Problem:
    energy = mbd.Integral(mbd.StrainEnergy("arm"))
    return mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-90, 90]))


def test_bodies_of_a_result_have_its_design():
    """As for the study of mbd.load: a problem and a design [n], which may have the variable of a min-max problem behind."""
    model = problem()
    before = model.system.body("arm").laminate.angles.detach().clone()
    for wrapped in (model, mbd.optimization.RobustProblem(model, 0.01, "worst")):
        result: Any = SimpleNamespace(problem=wrapped, x=np.array([0.1, 0.2, 1.0])[: len(wrapped.names)])
        arm: Any = flexible_bodies("design", result)[0]
        assert arm.laminate.angles.tolist() == [0.1, 0.2]
    assert torch.equal(model.system.body("arm").laminate.angles, before)


def test_bodies_of_a_system_are_its_own():
    system = mbd.examples.arm()
    assert flexible_bodies("design", system) == [system.body("arm")] == flexible_bodies("design", system.body("arm"))


@pytest.mark.parametrize("design", [None, 3, [1.0], SimpleNamespace(problem=3, x=np.zeros(1))], ids=str)
def test_other_designs_are_refused(design):
    with refused("design"):
        flexible_bodies("design", design)


def test_a_multistart_without_a_feasible_design_is_refused():
    with refused("design"):
        flexible_bodies("design", MultistartResult([], []))
