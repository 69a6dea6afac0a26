"""The angle of a spring or stop about an axis, for all ways to put the axes of the body."""

from __future__ import annotations

import math

import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.design.test_angle import cube_rotations
from tests.refused import refused

J, K = 0.02, 3.0


def hinged(axes: torch.Tensor, kind: str = "spring", frame: torch.Tensor | None = None) -> mbd.System:
    ground, door = mbd.Ground(), mbd.RigidBody("door", 1.0, (J, J, J), axes=axes)
    x = (axes if frame is None else axes @ frame)[:, 0]
    if kind == "stop":
        element = mbd.RotationalStop(ground.at(), door.at(axes=frame), "z", upper=0.1, stiffness=K, name="element")
    else:
        rest = math.atan2(float(x[1]), float(x[0]))
        element = mbd.RotationalSpringDamper(
            ground.at(), door.at(axes=frame), "z", stiffness=K, rest=rest, name="element"
        )
    return mbd.System([door], [mbd.Revolute(ground.at(), door.at(), axis="z")], [element])


def test_a_spring_acts_or_is_refused_by_name():
    """Its axis x lies along the hinge in eight of the 24; in the others it gives the frequency of the closed form."""
    rotations = cube_rotations()
    along = [x for x in rotations if abs(float(x[2, 0])) > 0.5]
    assert len(along) == 8
    for axes in along:
        for kind in ("spring", "stop"):
            with refused("element.b", None, "perpendicular to the axis 'z'"):
                hinged(axes, kind)
        system = hinged(axes, frame=axes.T)
        assert_close(mbd.equilibrium(system).vibrations[0].frequencies[0], expected(), rtol=1e-9, atol=0)
    for axes in (x for x in rotations if abs(float(x[2, 0])) < 0.5):
        assert_close(mbd.equilibrium(hinged(axes)).vibrations[0].frequencies[0], expected(), rtol=1e-9, atol=0)


def expected() -> torch.Tensor:
    return torch.tensor(math.sqrt(K / J) / (2.0 * math.pi), dtype=torch.float64)
