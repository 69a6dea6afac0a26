"""Exact beams converge with the square of the elements' length: curved, twisted, tapered, under all kinds of loads.

In motion with the square of the step, too.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import PLANE, bend, coupled, given, twisted
from tests.validation.beam_motions import flying_rod, right_angle


def tapered(elements: int) -> mbd.ExactBeam:
    table = mbd.SectionTable([0.0, 0.5, 1.0], [(scale * coupled(), PLANE) for scale in (1.0, 0.5, 0.4)])
    return mbd.ExactBeam("blade", mbd.BeamLine.straight(1.0, elements), table)


def straight(elements: int) -> mbd.ExactBeam:
    return mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, elements), given(1e4, 1e4, 1e4, 1.0, 1.0, 2.0))


CASES = {
    "bend": (bend, {"loads": {"end": (0.0, 0.0, 600.0)}}),
    "twisted": (twisted, {"loads": {"end": (0.0, 0.0, -4e6)}}),
    "tapered": (tapered, {"loads": {"end": (0.1, 0.6, 0.4)}}),
    "follower": (straight, {"follower_loads": {"end": (0.0, 3.0, 1.0)}}),
    "line loads": (straight, {"line_load": (0.0, 4.0, 1.0), "follower_line_load": (0.0, 1.0, 3.0, 0.2, 0.0, 0.0)}),
    "spin": (straight, {"line_load": (0.0, 3.0, 0.0), "gravity": (0.0, 0.0, -3.0), "spin": (0.0, 0.5, 1.0)}),
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_second_order(case):
    make, loads = CASES[case]
    tips = []
    for n in (8, 16, 32):
        state = make(n).equilibrium(**loads)
        assert state.status == "ok"
        tips.append(torch.cat([state.nodes[-1], state.rotations[-1].flatten()]).numpy())
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise(tips)]
    assert math.log2(steps[0] / steps[1]) == pytest.approx(2.0, abs=0.15)


MOTIONS = {"frame": right_angle, "rod": flying_rod}


def place(beam: str, elements: int, steps: int) -> torch.Tensor:
    """Of the tip after 4 s."""
    motion = mbd.simulate(MOTIONS[beam](elements), 4.0, steps=steps, gradients="none").require_ok()
    return motion.body(beam).nodes[0, -1, -1]


@pytest.mark.thorough
@pytest.mark.parametrize("beam", MOTIONS)
@pytest.mark.usefixtures("compiled")
def test_second_order_in_motion(beam):
    """Errors of the finest: less than 0.5 % of the rod with 32 elements, 1e-4 of it with 400 steps."""
    for result, level in (
        ([place(beam, n, 200) for n in (8, 16, 32)], 5e-3),
        ([place(beam, 4, steps) for steps in (100, 200, 400)], 1e-3),
    ):
        one, two = (float((b - a).norm()) for a, b in pairwise(result))
        assert math.log2(one / two) == pytest.approx(2.0, abs=0.2)
        assert two / 3.0 < level
