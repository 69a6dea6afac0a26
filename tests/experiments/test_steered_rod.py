"""Fibers that steer against straight ones, on a coarse mesh: gradients, what is gained, and the least radius of the paths."""

from __future__ import annotations

import math

import numpy as np
import pytest

import torchmbd as mbd
from experiments.models.steered_rod import RADIUS, steered, straight

pytestmark = pytest.mark.usefixtures("compiled")
CELLS, STRAIGHT = (12, 6), [0.0, math.pi / 2, 0.0]  # the best straight fibers of the recorded run


@pytest.fixture(scope="module")
def reference() -> float:
    [result] = straight(STRAIGHT, CELLS).evaluate(np.array([STRAIGHT]), True)
    assert result.objective_gradient is not None
    assert np.abs(result.objective_gradient).max() < 1e-6 * result.objective  # by symmetry
    return result.objective


def test_gradient_against_differences():
    problem = steered(STRAIGHT, (4, 3), CELLS)
    x, direction = problem.start, np.random.default_rng(0).standard_normal(len(problem.start))
    [exact] = problem.evaluate(x[None], True)
    assert exact.objective_gradient is not None
    h = 1e-4 * direction
    y = [e.objective for e in problem.evaluate(np.stack([x + h, x - h, x + 2 * h, x - 2 * h]), False)]
    rough = (8.0 * (y[0] - y[1]) - (y[2] - y[3])) / 12e-4
    assert exact.objective_gradient @ direction == pytest.approx(rough, rel=1e-6)


@pytest.mark.thorough
def test_steered_fibers_beat_the_best_straight_ones(reference):
    result = mbd.optimize(steered(STRAIGHT, (4, 3), CELLS), method="slsqp", max_iterations=15, progress=False)
    assert result.value < 0.93 * reference


@pytest.mark.slow
def test_the_radius_of_the_paths_is_kept(reference):
    problem = steered(STRAIGHT, (4, 3), CELLS, RADIUS)
    result = mbd.optimize(problem, method="slsqp", max_iterations=40, progress=False)
    assert result.violation < 1e-3
    assert result.value < 0.95 * reference
