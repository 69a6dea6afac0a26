"""Steps after an event, which are made together with those before it and are lost: what happens in them counts nowhere."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torchmbd as mbd


def _pull(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """A law that does not exist for lengths of 0 to 0.4 m."""
    return torch.where((s > 0.4) | (s == 0.0), -1.0 / (s * s).clamp_min(1e-2), torch.nan)


@pytest.mark.parametrize("method", ["generalized_alpha", "rk4", "dopri5"])
def test_a_law_may_end_where_the_phase_does(method):
    """A fall towards a center from rest at 1 m: 0.5 m are reached after (pi / 4 + 1 / 2) / sqrt(2) s."""
    ground, ball = mbd.Ground(), mbd.RigidBody("ball", 1.0, (0.1, 0.1, 0.1), position=(1.0, 0.0, 0.0))
    slide = mbd.Prismatic(ground.at(), ball.at(), axis="x", name="slide")
    system = mbd.System([ball], [slide], [mbd.SpringDamper(ground.at(), ball.at(), law=_pull, name="pull")])
    near = mbd.Event(mbd.Position("ball", "x") - 0.5, "either")
    phases = [mbd.Phase(until=near), mbd.Phase(lock=["slide"])]
    motion = mbd.simulate(system, 2.0, steps=200, phases=phases, method=method, gradients="none")
    assert motion.status == ["ok"]
    expected = (0.25 * torch.pi + 0.5) / 2.0**0.5
    assert float(motion.switches[0].t) == pytest.approx(expected, abs=1e-4)
