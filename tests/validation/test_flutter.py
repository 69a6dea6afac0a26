"""Beck's column: a cantilever under a force that follows its tip flutters from 20.0509 E I / L^2 on.

Source: M. Beck, Die Knicklast des einseitig eingespannten, tangential gedrückten Stabes, ZAMP 3 (1952) 225-228.
"""

from __future__ import annotations

import pytest

import torchmbd as mbd

E, I, L = 70e9, 1e-10, 1.0
LIMIT = 20.0509


def stable(push: float, elements: int) -> bool:
    """Whether the straight column is stable under a force in units of E I / L^2."""
    strip = mbd.GivenSection.isotropic(E=E, nu=0.3, density=2700.0, area=1e-4, Iyy=100.0 * I, Izz=I, J=3e-10)
    column = mbd.FlexibleBeam("column", mbd.BeamLine.straight(L, elements), strip)
    clamp = mbd.Fixed(mbd.Ground().at(), column.at("start"))
    follower = mbd.Force(column.at("end"), (-push * E * I / L**2, 0.0, 0.0), axes="frame")
    return mbd.equilibrium(mbd.System([column], [clamp], [follower])).stable


@pytest.mark.thorough
@pytest.mark.parametrize(("elements", "above"), [(10, 0.0238), (20, 0.0059)])
def test_a_column_flutters_under_a_force_that_follows(elements, above):
    """The limit of a mesh lies above by an error of second order: 2.4 % with 10 elements, 0.6 % with 20."""
    assert stable(LIMIT * (1.0 + 0.9 * above), elements)
    assert not stable(LIMIT * (1.0 + 1.1 * above), elements)
