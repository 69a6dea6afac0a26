"""An experiment file as the start of what files have no keys for."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.thorough
def test_the_problem_of_a_file_is_that_of_its_study(write):
    problem = mbd.problem_of(write(), "simulate.steps=60", "design.rod.laminate.angles.start=[30, -60]")
    assert problem.names == ["rod.laminate.angles[0]", "rod.laminate.angles[1]"]
    np.testing.assert_allclose(np.degrees(problem.start), [30.0, -60.0])
    own = mbd.Problem(
        problem.system,
        0.01,
        minimize=mbd.Integral(mbd.StrainEnergy("rod")),
        subject_to=mbd.Max(mbd.StrainEnergy("rod")) <= "initial",
        bounds=mbd.deg([-90, 90]),
        start=mbd.deg([30, -60]),
        steps=60,
    )
    X = np.radians([[45.0, -45.0], [0.0, 10.0]])
    for one, other in zip(problem.evaluate(X, True), own.evaluate(X, True), strict=True):
        assert one.objective == other.objective
        assert np.array_equal(one.constraints, other.constraints)


@pytest.mark.thorough
def test_it_serves_steps_and_tolerances(write):
    problem = mbd.problem_of(write(subject_to=None), "simulate.duration=0.002", "simulate.steps=8")
    laid = mbd.optimization.optimize_discrete(problem, mbd.deg(15), max_iterations=2, max_boxes=2, max_neighbors=4)
    assert laid.best is not None
    steps = np.degrees(laid.best.x) / 15.0
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    robust = mbd.optimization.RobustProblem(problem, mbd.deg(2.0))
    (result,) = robust.evaluate(robust.start[None], False)
    assert result.ok


def test_what_is_wrong_is_named(write):
    with pytest.raises(mbd.InputError, match="minimise"):
        mbd.problem_of(write(minimise={}))
