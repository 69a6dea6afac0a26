"""What the experiments of robust design and of the front say, on problems of closed formulas."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.paper import pareto, robust
from tests.optimization.analytic import Analytic
from tests.optimization.test_pareto import two_bowls
from torchmbd.optimization import pareto_front


def test_samples_of_a_tolerance():
    """The mean of a uniform square is a third; the worst lies on an edge of the box, which is sampled."""
    problem = Analytic("square", [0.0, 0.0], lambda x: x[0] ** 2 + 1, lambda x: [x[1] - 0.1], lower=-1, upper=1)
    mean, error, worst, violation = robust.sampled(problem, np.zeros(2), 0.3, 4000)
    assert mean == pytest.approx(1 + 0.3**2 / 3, abs=4 * error)
    assert 0 < error < 1e-3
    assert worst == pytest.approx(1.09, rel=1e-12)
    assert violation == pytest.approx(0.2, rel=1e-12)


def test_the_picture_shows_every_point_of_the_front():
    front = pareto_front(two_bowls(), divisions=3)
    (axes,) = pareto.drawn(front, np.array([[30.0, 900.0], [40.0, 800.0]])).axes
    (line,) = axes.lines
    # The second is drawn as what it maximizes.
    np.testing.assert_array_equal(line.get_xydata(), front.criteria * [1, -1])
    assert axes.get_xlabel().endswith("[mJ s]")


def test_how_far_a_front_is_beaten():
    front = pareto_front(two_bowls(), divisions=3)
    spans = front.nadir - front.utopia
    point = front.criteria[1]
    assert pareto.beaten(front, np.array([point - [0.2, 0.1] * spans, point + spans])) == pytest.approx(0.1)
    assert pareto.beaten(front, front.criteria) == pytest.approx(0.0, abs=1e-12)
