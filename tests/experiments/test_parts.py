"""Ordinary parts: the same question in Python and in a file, default settings, no failed design, an independent optimum.

experiments/models/part_optima.py has the independent numbers.
"""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import numpy as np
import pytest

import torchmbd as mbd
from experiments.models.part_optima import BLADE, FOLDER, MASSES, OPTIMA, blade_frequency, blade_table
from torchmbd.design.problem_steps import with_steps

pytestmark = pytest.mark.usefixtures("optimized")  # as a user has it
NAMES = sorted(file.stem for file in FOLDER.glob("*.yaml"))
MOST_LINES = 30


@pytest.fixture
def optimized(compiled: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled steps with a level of optimization: a search makes more of them than the -O0 of other tests is worth."""
    monkeypatch.setenv("TORCHMBD_CXXFLAGS", "-O1")


def script_of(name: str) -> Any:
    return importlib.import_module(f"experiments.models.parts.{name}")


def test_eight_scripts_and_files_of_few_lines():
    scripts = [file for file in FOLDER.glob("*.py") if file.stem != "__init__"]
    assert sorted(file.stem for file in scripts) == NAMES
    assert len(NAMES) == 8
    for file in [*scripts, *FOLDER.glob("*.yaml")]:
        assert sum(bool(line.strip()) for line in file.read_text().splitlines()) <= MOST_LINES, file.name


@pytest.mark.thorough
@pytest.mark.parametrize("name", NAMES)
def test_the_default_search_finds_the_independent_optimum(name: str):
    """Mass of the start by a sum over walls; no failed design, no warning; the optimum; the file asks the same."""
    problem = script_of(name).problem()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        result = mbd.optimize(problem, progress=False)
    if name in MASSES:
        wall = 1e-3 if name == "tube_arm" else 1e-9  # tubes are polygons
        assert result.history[0].objective == pytest.approx(MASSES[name](problem.start), rel=wall)
    assert result.failures == 0
    assert result.violation <= 1e-4
    assert abs(result.value) == pytest.approx(OPTIMA[name](problem), rel=0.01)  # of what is maximized: its negative
    require_equal(problem, with_steps(mbd.problem_of(FOLDER / f"{name}.yaml"), problem.steps))


def require_equal(script: mbd.Problem, file: mbd.Problem) -> None:
    """Values and gradients of a design beside the start."""
    order = [script.names.index(entry) for entry in file.names]
    beside = (file.start + 0.05 * (file.upper - file.start))[None]
    [a], [b] = file.evaluate(beside, True), script.evaluate(beside[:, np.argsort(order)], True)
    assert a.ok, a.status
    assert b.objective == pytest.approx(a.objective, rel=1e-9)
    for x, y in (
        (a.constraints, b.constraints),
        (a.objective_gradient, b.objective_gradient[order]),
        (a.constraint_gradients, b.constraint_gradients[:, order]),
    ):
        np.testing.assert_allclose(y, x, rtol=1e-9, atol=1e-9 * np.abs(x).max(initial=1e-9))


def test_the_table_of_the_blade_is_that_of_the_turbine():
    """Published of the fixed blade: 17,740 kg, first flap 0.67 to 0.68 Hz, first edge 1.08 to 1.10 Hz."""
    table = blade_table()
    assert np.trapezoid(table[:, 1], table[:, 0]) * BLADE == pytest.approx(17740.0, rel=5e-3)
    assert blade_frequency(0.0, column=2) == pytest.approx(0.675, abs=0.005)
    assert blade_frequency(0.0, column=3) == pytest.approx(1.09, abs=0.01)
