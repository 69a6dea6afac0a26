"""Both phases of the antenna: what is held stays, what is released moves, panels end in line."""

from __future__ import annotations

import math

import pytest

import torchmbd as mbd
from experiments.models.sar_antenna import build, phi3, theta
from experiments.models.sar_antenna_whole import LATCH, REST, deployed, hinges, phi2, unlocked, whole


@pytest.mark.slow
def test_both_phases_deploy_the_rigid_antenna():
    motion = deployed(steps=400).require_ok()
    first, second, third = (float(switch.t[0]) for switch in motion.switches)
    assert [switch.phase for switch in motion.switches] == ["rest", "2", "3"]
    assert 9.0 < first < second < third < 20.0
    assert second - first == pytest.approx(REST)
    held, t = phi2(motion)[0], motion.t
    assert float((held[t < second] - held[0]).abs().max()) < 1e-6
    assert float(phi3(motion)[0, t < first].min()) > LATCH - 1e-3
    for angle in hinges(motion).values():
        assert float((angle[0, t > third] - LATCH).abs().max()) < math.radians(0.05)


@pytest.mark.slow
def test_both_phases_deploy_flexible_panels():
    """A coarse mesh, few modes: it comes to the end, and bends while it is driven."""
    motion = deployed([(8.66, -48.32)], modes=4, cells=(16, 8), steps=2000).require_ok()
    assert [switch.phase for switch in motion.switches] == ["rest", "2", "3"]
    for angle in hinges(motion).values():
        assert float(angle[0, -1].abs()) < math.radians(2.0)
    U = motion.body("panel2").strain_energy[0]
    assert float(U[motion.t < 9.0].max()) > 1e-3
    assert float(U[motion.t > 10.0].max()) > float(U[motion.t < 9.0].max())


def test_the_held_antenna_unfolds_as_without_the_second_loop():
    """Phase 1 of the whole: panel 2 and both outer loops stay, the crank moves as in the model of phase 1."""
    alone = mbd.simulate(build(None), 1.0, steps=20).require_ok()
    system = whole()
    held = system.with_joints([joint for joint in system.joints if joint.name[0] != "L"])
    motion = mbd.simulate(held, 1.0, steps=20).require_ok()
    assert float((theta(motion) - theta(alone)).abs().max()) < 1e-7
    assert float((phi2(motion) - phi2(motion)[:, :1]).abs().max()) < 1e-7


def test_latches_are_not_counted():
    assert {joint.name[0] for joint in unlocked().joints} == {"R", "S"}
