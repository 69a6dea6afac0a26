"""The x-axis of a laminate in the axes of its mesh."""

from __future__ import annotations

import math

import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON

PLATE = mbd.mesh.rectangle(0.3, 0.1, (6, 2), "triangle")


def values(body):
    return torch.linalg.eigvalsh(body.structure()["Kr"].detach())


def test_the_direction_turns_the_laminate():
    """The sum of the plies' shear stiffness is a tensor; that of equal energy is one of the laminate's own axes."""
    turn, thickness = math.radians(30), [1e-3, 2e-3, 1.5e-3]
    one, other = (
        mbd.Laminate(CARBON, mbd.deg(angles), thickness, shear_correction=5 / 6)
        for angles in ([20, -50, 75], [50, -20, 105])
    )
    result = mbd.FlexibleBody.plate("plate", PLATE, one, 3, direction=(math.cos(turn), math.sin(turn), 0.0))
    assert_close(values(result), values(mbd.FlexibleBody.plate("plate", PLATE, other, 3)), rtol=1e-10, atol=0)
