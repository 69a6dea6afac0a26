"""Both phases of the rigid antenna: what is held stays, what is released moves, panels end in line."""

from __future__ import annotations

import math

import pytest

import torchmbd as mbd
from experiments.sar_antenna import build, phi3
from experiments.sar_antenna_whole import LATCH, phases, phi2, whole


@pytest.mark.slow
def test_both_phases_deploy_the_rigid_antenna():
    motion = mbd.simulate(whole(), 20.0, steps=400, phases=phases()).require_ok()
    first, second, third = (float(switch.t[0]) for switch in motion.switches)
    assert [switch.phase for switch in motion.switches] == ["rest", "2", "3"]
    assert 8.0 < first < second < 10.0 < third < 20.0
    held, t = phi2(motion)[0], motion.t
    assert float((held[t < second] - held[0]).abs().max()) < 1e-6
    assert float(phi3(motion)[0, t < first].min()) > LATCH - 1e-3
    assert float(phi3(motion)[0, t > second].abs().max()) < 1e-4
    assert abs(float(held[-1])) < math.radians(0.5)


def test_the_held_antenna_unfolds_as_without_the_second_loop():
    """Phase 1 of the whole: panel 2 and both outer loops stay, the crank moves as in the model of phase 1."""
    alone = mbd.simulate(build(None), 1.0, steps=20).require_ok()
    motion = mbd.simulate(whole(), 1.0, steps=20).require_ok()
    assert float((phi3(motion) - phi3(alone)).abs().max()) < 1e-7
    assert float((phi2(motion) - phi2(motion)[:, :1]).abs().max()) < 1e-7
