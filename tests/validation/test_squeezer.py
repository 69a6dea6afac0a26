"""Andrews' squeezing mechanism against the published reference; data and sources in squeezer.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.validation.squeezer import ANGLES, BODIES, RATES, START, of_body, squeezer


def test_loops_close_at_the_published_angles():
    system = squeezer()
    result = system.describe()
    assert (result.rows, result.rank, result.freedoms) == (50, 41, 1)
    dynamics = system.dynamics()
    with torch.no_grad():
        q, v = dynamics.initial.solve(dynamics)
    assert float((q[:, 0, 0] - dynamics.initial.q).abs().max()) < 1e-14
    assert not v.any()


def test_first_accelerations():
    """At rest at the start: beta'' and Theta'' as published with the initial values; all others are zero."""
    system = squeezer()
    with torch.no_grad():
        q, v = system.dynamics().initial.solve(system.dynamics())
        a, _ = system.dynamics().accelerations(torch.zeros((), dtype=torch.float64), q, v)
    T = system.topology
    turning = {name: float(a[5 * T.bodies + T.names.index(name)]) for name in BODIES}
    assert turning["K1"] == pytest.approx(14222.4439199541138705911625887, rel=1e-9)
    assert turning["K2"] - turning["K1"] == pytest.approx(-10666.8329399655854029433719415, rel=1e-9)
    assert max(abs(turning[name]) for name in ("K3", "K4", "K5", "K6", "K7")) < 1e-5


@pytest.mark.slow
def test_the_published_reference():
    """Angles (full turns included) and rates at 0.03 s, to 1e-6 of the reference."""
    motion = mbd.simulate(squeezer(), 0.03, method="dopri8", steps=600, rtol=1e-10, atol=1e-10).require_ok()
    angles, rates = (dict(zip(START, x, strict=True)) for x in (ANGLES, RATES))
    for name in BODIES:
        view = motion.body(name)
        turn = np.unwrap(torch.atan2(view.A[0, :, 1, 0], view.A[0, :, 0, 0]).numpy())
        start = of_body(START, name)
        assert turn[0] == pytest.approx(math.remainder(start, 2 * math.pi), abs=1e-12)
        assert turn[-1] - turn[0] == pytest.approx(of_body(angles, name) - start, rel=1e-6, abs=1e-7)
        assert float(view.omega[0, -1, 2]) == pytest.approx(of_body(rates, name), rel=1e-6, abs=1e-3)


@pytest.mark.thorough
def test_the_beginning_against_the_structural_integrator():
    """Two routes, a tenth of the way: 0.003 s."""
    motion = mbd.simulate(squeezer(), 0.003, method="dopri5", steps=30, rtol=1e-8, atol=1e-8).require_ok()
    other = mbd.simulate(squeezer(), 0.003, steps=60, iterations=(4, 4)).require_ok()
    assert float(other.energies.balance.abs().max()) < 1e-3 * float(other.energies.kinetic.max())
    for name in BODIES:
        one, two = (x.body(name).A[0, -1] for x in (motion, other))
        assert float((one - two).abs().max()) < 1e-4
