"""The first step of adaptive methods: no longer than the vibrations bear that have not begun yet."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from tests.mechanisms import GRAVITY, laminate, plate

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["dopri5", "dopri8"])
def test_a_stiff_body_begins_to_move(method):
    """Undeformed as it starts, its slopes tell nothing of its vibrations: dopri8 overflowed in its first step."""
    made_of, interface = laminate((20.0, -50.0), 3e-3), ["left"]
    body = plate("panel", 3, made_of=made_of, reduction="craig-bampton", interface=interface)
    body = body.moving(angular_velocity=(1.0, 0.5, -0.3))
    ground = mbd.Ground().at(*body.at("left").point.tolist())
    system = mbd.System([body], [mbd.PointOnPlane(ground, body.at("left"))], gravity=GRAVITY)
    result = mbd.simulate(system, 1e-4, method, 4)
    assert result.status == ["ok"]
    exact = mbd.simulate(system, 1e-4, "rk4", 200).require_ok()
    assert float((result.q - exact.q[:, ::50]).abs().max()) < 1e-8
