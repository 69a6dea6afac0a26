"""Robust losses: those of SciPy, with their derivatives, and none for priors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from torchmbd.extensions.identification.losses import LOSSES, of_rows

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(40, 2))
VALUES = POINTS @ [1.0, -2.0] + np.where(np.arange(40) % 8, 0.1, 5.0) * RNG.normal(size=40)


@pytest.mark.parametrize("name", LOSSES)
def test_minima_are_those_of_scipy(name):
    ends = [
        least_squares(lambda b: POINTS @ b - VALUES, [0.0, 0.0], loss=loss, f_scale=0.3, gtol=1e-12, xtol=1e-12).x
        for loss in (name, LOSSES[name])
    ]
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-6)


@pytest.mark.parametrize("name", LOSSES)
def test_derivatives(name):
    z, h = np.array([0.1, 0.7, 1.5, 30.0]), 1e-5
    value, slope, curvature = LOSSES[name](z)
    up, down = LOSSES[name](z + h), LOSSES[name](z - h)
    np.testing.assert_allclose(slope, (up[0] - down[0]) / (2.0 * h), rtol=1e-6)
    np.testing.assert_allclose(curvature, (up[1] - down[1]) / (2.0 * h), rtol=1e-5, atol=1e-9)
    assert value.shape == (4,)


def test_priors_keep_the_plain_square():
    rho = of_rows(LOSSES["cauchy"], 1)(np.array([100.0, 100.0]))
    assert rho[0].tolist() == [np.log1p(100.0), 100.0]
    assert rho[:, 1].tolist() == [100.0, 1.0, 0.0]
