"""Rows of a motion, made on demand, against the whole of it."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.examples.slider_crank import DURATION, build
from torchmbd.results.time_rows import IntegratedSignals, TensorSignals

ANGLES = "rod.laminate.angles"
NAMES = ("q", "v", "a")


@pytest.fixture(scope="module")
def motion():
    """The slider-crank: crank condensed to a prescribed body, slider guided; two designs with sensitivities."""
    designs = {ANGLES: torch.tensor([[0.3, -0.2], [0.5, 0.9]], dtype=torch.float64)}
    system = build(2, modes=3, cells=(6, 2))
    return mbd.simulate(
        system, 0.2 * DURATION, steps=40, designs=designs, gradients="forward", variables=[ANGLES]
    ).require_ok()


def test_the_system_is_a_condensed_one(motion):
    history = motion.sensitivities.history
    assert history.q.shape[1] < motion.q.shape[2] == motion.dynamics.topology.n_q
    assert motion.v.shape[2] == motion.dynamics.topology.n_v > history.v.shape[1]


@pytest.mark.parametrize("name", NAMES)
def test_rows_are_rows_of_the_whole(motion, name):
    whole, slopes = motion.sensitivities.values(name), motion.sensitivities.tangents(name)
    assert slopes.shape == (*whole.shape, 2)
    n = whole.shape[2]
    for rows in ([0], list(range(n)), [n - 1, 0, n // 2], list(range(n - 3, n)), [-1, 2, -n]):
        result = IntegratedSignals(motion.sensitivities.history)
        assert_close(result.values(name, rows), whole[..., rows], rtol=0, atol=0)
        assert_close(result.tangents(name, rows), slopes[..., rows, :], rtol=0, atol=0)
        assert result.values(name, rows).is_contiguous()
    with pytest.raises(IndexError):
        IntegratedSignals(motion.sensitivities.history).values(name, [n])


def test_a_carrier_moves_as_its_drive_says(motion):
    """The crank turns with a constant speed about its bearing: the parts that were never integrated."""
    crank = motion.body("crank")
    assert (
        motion.dynamics.topology.names.index("crank") not in motion.sensitivities.history.expansion.condensation.bodies
    )
    speed = crank.omega[0, 0].norm()
    assert float(speed) > 1.0
    assert_close(crank.omega.norm(dim=-1), speed.expand(2, 41), rtol=1e-12, atol=0)
    rows = motion.dynamics.topology.p_slice(motion.dynamics.topology.names.index("crank"))
    assert float(motion.sensitivities.tangents("q", rows).abs().max()) == 0.0


def test_given_rows():
    q = torch.arange(24, dtype=torch.float64).reshape(2, 3, 4)
    signals = TensorSignals({"q": q})
    assert_close(signals.values("q", [3, 1]), q[..., [3, 1]])
    assert signals.tangents("q", [3, 1]) is None


@pytest.mark.thorough
def test_a_motion_without_sensitivities_has_no_tangents():
    motion = mbd.simulate(build(2, modes=3, cells=(6, 2)), 0.02 * DURATION, steps=4, gradients="none")
    assert motion.dq_db is motion.dv_db is motion.da_db is motion.dlam_db is None


@pytest.mark.thorough
def test_a_motion_stays_what_it_was(motion):
    """Laws and designs that change afterwards change nothing that has not been looked at yet."""
    speed = torch.tensor(300.0, dtype=torch.float64)
    body, ground = mbd.RigidBody("wheel", mass=1.0, inertia=(1.0, 1.0, 1.0)), mbd.Ground()
    link = mbd.RigidBody("link", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.1, 0.0, 0.0))
    joints = [
        mbd.Revolute(ground.at(), body.at(), axis="z"),
        mbd.Drive(ground.at(), body, axis="z", angle=lambda t: speed * t),
        mbd.Spherical(body.at(0.1, 0.0, 0.0), link.at()),
    ]
    turned = mbd.simulate(mbd.System([body, link], joints), 1e-3, steps=4)
    assert turned.signals.history.expansion is not None
    speed.mul_(0.5)
    assert_close(turned.body("wheel").omega[..., 2], torch.full((1, 5), 300.0, dtype=torch.float64))
    designs = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    system = build(2, modes=3, cells=(6, 2))
    first, second = (mbd.simulate(system, 1e-4, steps=2, designs={ANGLES: designs}) for _ in range(2))
    shapes = first.modes("rod")
    designs.add_(0.5)
    assert_close(second.modes("rod"), shapes, rtol=0, atol=0)


@pytest.mark.thorough
def test_a_motion_with_an_adjoint_has_no_tangents_and_says_so():
    motion = mbd.simulate(build(2, modes=3, cells=(6, 2)), 0.02 * DURATION, steps=4, gradients="reverse")
    with refused("gradients", "reverse", "dq_db", "gradients='forward'"):
        _ = motion.dq_db
