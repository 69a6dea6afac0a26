"""A beam as a chain of floating frames converges with the square of the number of pieces, also where it bends in space."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

import torchmbd as mbd

GROUND = mbd.Ground()
SECTION = mbd.GivenSection(
    torch.diag(torch.tensor([1e4, 1e4, 1e4, 1.0, 1.0, 2.0], dtype=torch.float64)),
    torch.diag(torch.tensor([1.0, 1.0, 1.0, 2e-4, 1e-4, 1e-4], dtype=torch.float64)),
)
CASES = {  # force [N] and moment [N m] at the end; error of 8 pieces [m]
    "moment": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.5), 3e-3),
    "space": ((0.5, 1.5, 1.0), (0.5, 0.0, 0.0), 2.5e-3),
}


def tip(n: int, force: tuple[float, ...], moment: tuple[float, ...]) -> Tensor:
    """Place of the end of a cantilever of n pieces [3]."""
    chain = mbd.split(mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(1.0, 16), SECTION, reference="start"), n)
    end = chain.at("end")
    loads = [mbd.forces.Torque(end, moment), *([mbd.forces.Force(end, force)] if any(force) else [])]
    clamp = mbd.Fixed(GROUND.at(), chain.at("start"))
    system = mbd.System(chain.bodies, [clamp, *chain.joints], forces=loads, truncation=None)
    with torch.no_grad():
        result = mbd.equilibrium(system)
        if n == 2 and moment[2] > 1.0:
            with pytest.raises(mbd.DesignFailure, match="bodies bend until their modes have a negative mass"):
                _ = result.vibrations
        return result.body(chain.bodies[-1].name).at("end").position[0, 0]


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_second_order(case):
    force, moment, level = CASES[case]
    rod = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 64), SECTION)
    exact = rod.equilibrium(loads={"end": (*force, *moment)}).nodes[-1].detach()
    if case == "moment":  # an arc of 0.75 rad
        arc = [math.sin(0.75) / 0.75, (1.0 - math.cos(0.75)) / 0.75, 0.0]
        assert exact.tolist() == pytest.approx(arc, abs=1e-9)
    errors = [float((tip(n, force, moment) - exact).norm()) for n in (2, 4, 8)]
    assert errors[-1] < level
    for a, b in pairwise(errors):
        assert math.log2(a / b) == pytest.approx(2.0, abs=0.25)
