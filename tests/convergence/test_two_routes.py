"""The two routes converge together: values and gradients of generalized_alpha against a tight run of torchdiffeq.

One integrates the index-3 equations with equal steps and differentiates its discrete map; the other the index-1 form in
one augmented state with step control. They share the equations of motion and nothing of the time integration.
"""

from __future__ import annotations

import math

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import soft_slider_crank
from torchmbd.integrate import Trajectory

pytestmark = pytest.mark.thorough

DURATION = 0.01


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return soft_slider_crank(kind="triangle")  # levels below are of its frequencies


@pytest.fixture(scope="module")
def tight(system) -> Trajectory:
    return mbd.simulate(system, DURATION, "dopri5", steps=2, gradients="forward", rtol=1e-6, atol=1e-8).require_ok()


@pytest.fixture(scope="module")
def stepped(system) -> list[Trajectory]:
    return [mbd.simulate(system, DURATION, steps=n, gradients="forward").require_ok() for n in (100, 200)]


@pytest.mark.parametrize(("name", "level"), [("q", 1e-6), ("v", 2e-3), ("dq_db", 1e-5), ("dv_db", 2e-2)])
def test_generalized_alpha_converges_to_torchdiffeq_at_second_order(name, level, system, tight, stepped):
    """At the end time: coordinates, rates, and their sensitivities by both angles."""
    exact = getattr(tight, name)[0, -1]
    coarse, fine = (float((getattr(motion, name)[0, -1] - exact).abs().max()) for motion in stepped)
    assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)
    assert fine < level
    modal = slice(7 * system.topology.bodies, None) if "q" in name else slice(6 * system.topology.bodies, None)
    assert float(exact[modal].abs().max()) > 100 * float((getattr(stepped[1], name)[0, -1] - exact)[modal].abs().max())


def test_the_strain_energy_converges_at_second_order(tight, stepped):
    """Its value and its gradient, which also takes the derivative of the stiffness, at half time and at the end."""
    energy = mbd.StrainEnergy("rod")
    runs = [torch.cat([x[0, [steps // 2, -1]].flatten() for x in energy.series(motion)])
            for motion, steps in ((tight, 2), (stepped[0], 100), (stepped[1], 200))]  # fmt: skip
    coarse, fine = (float((x - runs[0]).abs().max()) for x in runs[1:])
    assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)
    assert fine < 2e-3 * float(runs[0].abs().max())
