"""Steps that statuses advise: `verify` and `torchmbd check` name the same number."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.design.test_verification import vibrating
from tests.refused import warned
from torchmbd.design.verification import advice, verification
from torchmbd.diagnosis.stated_steps import stated_steps
from torchmbd.integrate.lane_status import _status_of_steps
from torchmbd.integrate.statistics import Statistics

pytestmark = pytest.mark.usefixtures("compiled")


def flexible_status(steps: float) -> str:
    """Of a motion whose vibrations the steps do not resolve."""
    statistics = Statistics(step_error=torch.tensor([20.0]), suggested_steps=torch.tensor([steps]))
    return _status_of_steps(statistics, 0)


def test_the_number_is_that_of_the_status() -> None:
    assert stated_steps(["ok", "failed: a body turns by 3 rad in one step. Try: more steps"]) is None
    assert stated_steps([flexible_status(319.0)]) == 319
    assert stated_steps(["12 of 31 failed, all of them: " + flexible_status(319.0), flexible_status(80.0)]) == 319
    with warned("steps=160"):
        [status] = mbd.simulate(vibrating(16).system, 0.1, steps=16).status
    assert status.endswith("which are 40 for each period")
    assert stated_steps([status]) == 160  # 40 Hz for 0.1 s


def test_advice_is_that_of_the_status_where_it_is_more() -> None:
    """Steps were doubled, 48, where the status of a failed evaluation said 319."""
    problem = vibrating(24)
    assert advice(problem, 4.0) == "steps: 48 or more"
    assert advice(problem, 4.0, statuses=[flexible_status(319.0)]) == "steps: 319 or more"
    assert advice(problem, 400.0, statuses=[flexible_status(319.0)]) == "steps: 480 or more"
    more = "finer meshes of the flexible bodies"
    assert advice(problem, 4.0, {"mesh"}, [flexible_status(319.0)]) == f"{more} and steps: 319 or more"
    assert advice(problem, 4.0, {"mesh"}, [flexible_status(20.0)]) == more


def test_a_verification_names_the_steps_of_the_failed_evaluations() -> None:
    problem = vibrating(30)
    x = np.array([1.1])
    value = problem.evaluate(x[None], False)[0].objective
    search = f"converged; 12 of 31 evaluations failed, all of them: {flexible_status(319.0)}"
    result = verification(problem, x, value, search=search)
    assert not result.verified
    [said] = re.findall(r"steps: (\d+) or more", result.advice)
    assert said == "319"
    assert result.search == search
