"""Published motions of flexible beams.

Source: J. C. Simo, L. Vu-Quoc, On the dynamics of flexible beams under large overall motions - the plane case, J. Appl. Mech.
53 (1986) 849-863; On the dynamics in space of rods undergoing large motions, CMAME 66 (1988) 125-161.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.fem.exact_beam.cases import given, matrix
from tests.validation.beam_motions import PEAKS, flying_loads, flying_rod, momenta, right_angle

pytestmark = pytest.mark.usefixtures("compiled")

SPEED, RISE = 6.0, 15.0  # [rad/s], [s]


def spin_up(t: Tensor) -> Tensor:
    """Angle [rad] of the hub."""
    s, turn = t.clamp(max=RISE), 2.0 * math.pi / RISE
    return SPEED / RISE * (0.5 * s**2 + ((turn * s).cos() - 1.0) / turn**2) + SPEED * (t - RISE).clamp(min=0.0)


@pytest.mark.thorough
def test_spin_up():
    """The tip lags by 0.57 m at most, and ends 5.14e-4 m further out: E A = 2.8e7 N, E I = 1.4e4 N m2, 1.2 kg/m, 10 m."""
    section = given(2.8e7, 1e7, 1e7, 2.8e4, 1.4e4, 1.4e4, mass=matrix(1.2, 1.2, 1.2, 1.2e-3, 6e-4, 6e-4))
    blade = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(10.0, 8), section)
    hinge = mbd.Revolute(mbd.Ground().at(), blade.at("start"), axis="z", name="hinge")
    drive = mbd.Drive(mbd.Ground().at(), blade.at("start"), axis="z", angle=spin_up)
    motion = mbd.simulate(mbd.System([blade], [hinge, drive]), 20.0, steps=2000, gradients="none")
    assert motion.status == ["ok"]
    angle = spin_up(motion.t)
    x, y, _ = motion.body("blade").nodes[0, :, -1].T
    out, lag = angle.cos() * x + angle.sin() * y - 10.0, angle.sin() * x - angle.cos() * y
    assert abs(float(lag.max()) - 0.57) < 0.01 * 0.57
    assert abs(float(out[-300:].mean()) - 5.14e-4) < 0.01 * 5.14e-4


@pytest.mark.thorough
def test_flying_spaghetti():
    """Free in the plane, E A = G A = 1e4 N, E I = 500 N m2, 1 kg/m, 10 kg m; 8 N and 80 N m at one end for 2.5 s."""
    section = given(1e4, 1e4, 1e4, 500.0, 500.0, 500.0, mass=matrix(1.0, 1.0, 1.0, 20.0, 10.0, 10.0))
    turn = [[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]  # from (0, 8) down to (6, 0)
    rod = mbd.FlexibleBeam("rod", mbd.BeamLine.straight(10.0, 10), section, position=(0.0, 8.0, 0.0), axes=turn)

    def on(t: Tensor) -> Tensor:
        return 0.5 * (1.0 + torch.tanh((2.5 - t) / 0.02))

    push = mbd.Force(rod.at("end"), lambda t: torch.stack([8.0 * on(t), 0.0 * t, 0.0 * t]))
    twist = mbd.Torque(rod.at("end"), lambda t: torch.stack([0.0 * t, 0.0 * t, -80.0 * on(t)]))
    motion = mbd.simulate(mbd.System([rod], forces=[push, twist], free=["rod"]), 6.0, steps=600)
    assert motion.status == ["ok"]
    own, view = rod.structure(), motion.body("rod")
    momentum = sum(
        m * motion.body(f"rod_{k}").at(tuple((S / m).tolist())).velocity[0, -1]
        for k, (m, S) in enumerate(zip(own.mass, own.first, strict=True))
    )
    assert abs(float(momentum[0]) - 20.0) < 1e-2  # 8 N for 2.5 s: the mean speed is 2 m/s
    assert float(view.strain_energy.max()) > 40.0
    after = motion.t > 2.7
    stored = motion.energies.stored[0, after]
    assert float((stored - stored[0]).abs().max()) < 5e-3 * float(stored[0])


@pytest.mark.thorough
def test_right_angle_cantilever():
    """Displacements out of the plane as large as the legs: three peaks of the published curves."""
    motion = mbd.simulate(right_angle(10), 20.0, steps=400, gradients="none")
    assert motion.status == ["ok"]
    across = motion.body("frame").nodes[0, :, :, 2]
    for where, (start, end), expected in PEAKS:
        own = across[(motion.t >= start) & (motion.t <= end), 10 if where == "elbow" else -1]
        assert float(own[own.abs().argmax()]) == pytest.approx(expected, rel=1e-2)


@pytest.mark.thorough
def test_flying_spaghetti_in_space():
    """Momentum and angular momentum are those of the loads, the energy stays when they have gone."""
    motion = mbd.simulate(flying_rod(10), 7.0, steps=700, gradients="none")
    assert motion.status == ["ok"]
    linear, angular = momenta(motion, "rod")
    assert linear[-1].tolist() == pytest.approx([50.0, 0.0, 0.0], abs=1e-4)  # 20 N at most, for 5 s
    loads, tip = flying_loads(motion.t).T, motion.body("rod").nodes[0, :, -1]
    rate = loads[:, 3:] + torch.linalg.cross(tip, loads[:, :3])
    expected = angular[0] + torch.cumulative_trapezoid(rate, motion.t, dim=0)
    assert float((angular[1:] - expected).abs().max()) < 1e-4 * float(angular.abs().max())
    stored = motion.energies.stored[0, motion.t > 5.0]
    assert float((stored - stored[0]).abs().max()) < 1e-4 * float(stored[0])
    assert float(motion.energies.strain.max()) > 180.0
