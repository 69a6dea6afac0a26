"""What `check` says of the start design: responses beside their limits, and what is strange about them."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from torchmbd.optimization import Evaluation
from torchmbd.study.report.start_values import print_start_values, start_values

ENERGY = mbd.StrainEnergy("arm")
TORQUE = abs(mbd.Reaction("hinge", "z", kind="torque"))  # a hinge has none about its axis


def problem(*limits, **options):
    given = {"minimize": mbd.Max(ENERGY), "variables": ["arm.laminate.angles"], "steps": 20}
    return mbd.Problem(mbd.examples.arm(), 0.05, subject_to=limits, **given | options)


def text(asked: mbd.Problem) -> str:
    output = io.StringIO()
    print_start_values(start_values(asked), Console(file=output, width=80))
    return output.getvalue()


@pytest.mark.thorough
def test_values_are_those_of_the_motion():
    asked = problem(mbd.Mass("arm") >= 0.5, mbd.Max(ENERGY) <= "initial", mbd.Max(mbd.Angle("arm", "z")) <= 0.1)
    motion = asked.motion(asked.start)
    energy, mass, angle = (
        float(m(motion)[0]) for m in (asked.stated_objective, *(c.measure for c in asked.constraints[::2]))
    )
    result = start_values(asked)
    assert not isinstance(result, str)
    np.testing.assert_allclose([one.value for one in result], [energy, mass, energy, np.degrees(angle)], rtol=1e-12)
    assert [one.goal for one in result] == ["minimize", "at least 0.5", "at most initial", "at most 5.72958"]
    assert [one.unit for one in result] == ["J", "kg", "J", "deg"]
    assert result[1].note == ("violated" if mass < 0.5 else "")


@pytest.mark.thorough
def test_wrong_units_and_idle_constraints_are_pointed_at():
    mass = float(mbd.Mass("arm")(problem().motion(problem().start))[0])
    grams, few = mbd.Mass("arm") <= 5e3 * mass, mbd.Mass("arm") <= 1e-4 * mass
    result = start_values(problem(grams, few, mbd.Max(TORQUE) <= 5.0, mbd.Mass("arm") <= 2 * mass))
    assert not isinstance(result, str)
    notes = ["", "far from its limit: units?", "violated; units?", "is zero: is it what is meant?", ""]
    assert [one.note for one in result] == notes


@pytest.mark.thorough
@pytest.mark.parametrize("objective", ["mean", "worst"])
def test_of_scenarios_the_nearest_to_the_limit_is_shown(objective):
    cases = {"thin": {"arm.laminate.thickness": 1e-3}, "thick": {"arm.laminate.thickness": 2e-3}}
    given = {"variables": ["arm.laminate.angles"], "scenarios": cases, "steps": 20, "objective": objective}
    asked = mbd.Scenarios(mbd.examples.arm(), 0.05, mbd.Max(ENERGY), mbd.Mass("arm") <= 1e3, **given)
    masses = [float(mbd.Mass("arm")(asked.simulate(asked.start[None], scenario=name))[0]) for name in cases]
    energies = [float(mbd.Max(ENERGY)(asked.simulate(asked.start[None], scenario=name))[0]) for name in cases]
    result = start_values(asked)
    assert not isinstance(result, str)
    assert result[0].value == pytest.approx(max(energies) if objective == "worst" else np.mean(energies), rel=1e-9)
    assert result[1].value == pytest.approx(max(masses), rel=1e-9)


@pytest.mark.thorough
def test_the_lines_fit_a_terminal():
    lines = text(problem(mbd.Max(ENERGY) <= 1e-9, mbd.Mass("arm") <= 1.0)).splitlines()
    assert lines[0] == "at the start design:"
    assert [line.split()[0] for line in lines[1:]] == ["minimize", "at", "at"]
    assert max(map(len, lines)) <= 80


def test_a_start_that_cannot_be_simulated_says_why(monkeypatch):
    asked = problem()
    failed = [Evaluation.failure("failed: it does not close")]
    monkeypatch.setattr(asked, "evaluate", lambda X, gradients: failed)
    assert "the start design failed: it does not close" in text(asked)
