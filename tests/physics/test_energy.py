"""Energy, summed over the nodes: kept by a free motion, lost to damping, fed by a drive."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.physics.nodal_sums import sums

pytestmark = pytest.mark.usefixtures("compiled")

TIGHT = {"dopri5": {"rtol": 1e-7, "atol": 1e-9}, "dopri8": {"rtol": 1e-8, "atol": 1e-10}}


@pytest.mark.thorough
@pytest.mark.parametrize("method", TIGHT)
def test_an_undamped_free_motion_keeps_its_energy(method):
    """A spatial double pendulum with a flexible plate under gravity; exchanged are kinetic, strain and potential energy."""
    motion = mbd.simulate(pendulum(), 0.1, method, steps=10, **TIGHT[method]).require_ok()
    result = sums(motion)
    exchanged = float(result.potential.max() - result.potential.min())
    assert exchanged > 0.5 * float(result.kinetic.max())
    assert float(result.strain.max()) > 1e-3 * exchanged
    assert float((result.energy - result.energy[0]).abs().max()) < 1e-6 * exchanged


@pytest.mark.thorough
def test_generalized_alpha_without_dissipation_keeps_energy_to_second_order():
    drift = []
    for steps in (50, 100):
        motion = mbd.simulate(pendulum(), 0.1, steps=steps, spectral_radius=1.0, iterations=(6, 1)).require_ok()
        result = sums(motion)
        drift.append(float((result.energy - result.energy[0]).abs().max() / result.kinetic.max()))
    assert drift[1] < 1e-4
    assert drift[0] / drift[1] == pytest.approx(4.0, rel=0.3)


@pytest.mark.thorough
def test_what_is_lost_is_what_the_damping_takes():
    """dE/dt = -w' . D w'."""
    system = pendulum(damping=2e-3)
    motion = mbd.simulate(system, 0.1, "rk4", steps=200).require_ok()
    rod, result = motion.body("rod"), sums(motion)
    power = 2e-3 * torch.einsum("lti,lij,ltj->lt", rod.wd, rod.stiffness[0], rod.wd)[0]
    lost = result.energy[0] - result.energy[-1]
    assert float(lost) > 1e-2 * float(result.strain.max())
    # Simpson's rule over the samples.
    h = motion.t[1]
    taken = h / 3.0 * (power[0] + 4.0 * power[1:-1:2].sum() + 2.0 * power[2:-1:2].sum() + power[-1])
    assert float(taken) == pytest.approx(float(lost), rel=1e-4)


@pytest.mark.thorough
def test_a_drive_feeds_the_mechanism_through_its_multiplier(slider_crank_motion):
    """The slider-crank's energy changes by the drive's power -lam omega: sign and scale of the reaction torque."""
    motion = slider_crank_motion
    (row,) = (i for i, name in enumerate(motion.dynamics.topology.row_names) if name.startswith("drive"))
    work = torch.cumulative_trapezoid(-124.8 * motion.lam[0, :, row], motion.t)
    result = sums(motion)
    assert_close(work, (result.energy - result.energy[0])[1:], rtol=0, atol=2e-3 * float(work.abs().max()))
