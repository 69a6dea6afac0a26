"""Data of a design have the names of the table in data.py, and axes of tangents and lanes behind those of the table."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import box, rigid_pendulum
from torchmbd.examples import slider_crank, two_link_arm
from torchmbd.multibody.equations import data as table
from torchmbd.multibody.equations.data import ATTACHED, INERTIA


def with_variables() -> mbd.System:
    """A spring whose stiffness varies, and gravity as a Parameter."""
    gravity = torch.nn.Parameter(torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64))
    bob = box("bob")
    spring = mbd.SpringDamper(
        mbd.Ground().at(-1.0, 0.0, 0.0), bob.at(), stiffness=mbd.variable(20.0), rest=1.0, name="spring"
    )
    return mbd.System([bob], [mbd.Prismatic(mbd.Ground().at(), bob.at(), axis="x")], [spring], gravity=gravity)


def exact_beam() -> mbd.System:
    section = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)
    beam = mbd.FlexibleBeam("rotor", mbd.BeamLine.straight(1.0, elements=3), section, damping=1e-4)
    return mbd.System([beam], [mbd.Revolute(mbd.Ground().at(), beam.at("start"), axis="z")])


SYSTEMS: dict[str, Callable[[], mbd.System]] = {
    "rigid": rigid_pendulum,
    "flexible": lambda: slider_crank.build(2, cells=(4, 2), modes=2),
    "two flexible bodies": two_link_arm.build,
    "variables": with_variables,
    "exact beam": exact_beam,
}


def words() -> set[str]:
    """All names in the table."""
    text = table.__doc__ or ""
    return set(re.findall(r"[A-Za-z_][A-Za-z_0-9]*", text[: text.index("The symbols stand")]))


@pytest.mark.parametrize("name", SYSTEMS)
def test_names_are_those_of_the_table(name):
    data, T = SYSTEMS[name]().dynamics().data, SYSTEMS[name]().topology
    for key, x in data.items():
        assert key.startswith("law ") or key in words(), key
        assert x.shape[-2:] == (1, 1), key
    for key, rank in INERTIA.items():
        assert data[key].shape[rank] == T.bodies
    for key, axis in ATTACHED.items():
        assert key not in data or data[key].shape[axis] == (T.vectors if key == "x" else T.attached_flexible)
