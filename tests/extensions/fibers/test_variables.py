"""Gradients by the angles and thicknesses at controls of steered fibers: forward = reverse = differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.sensitivity.number_cases import STEPS, check, check_native, hung

MESH = mbd.mesh.rectangle(0.4, 0.1, cells=(6, 2))
NAMES = ["rod.laminate.angles", "rod.laminate.thickness"]


def system() -> mbd.System:
    field = mbd.fibers.FiberField(MESH, (3, 2), degree=1)
    angles = torch.tensor(
        [[0.1, 0.7], [0.5, 0.2], [0.3, -0.4], [0.9, 0.35], [-0.2, 0.6], [0.8, 0.15]], dtype=torch.float64
    )
    thickness = 1e-3 * torch.linspace(1.0, 1.3, 12).double().reshape(6, 2)
    laminate = mbd.fibers.SteeredLaminate(mbd.examples.carbon(), angles, thickness, field)
    return hung(mbd.FlexibleBody.plate("rod", MESH, laminate, modes=3, reference="left_edge"))


@pytest.mark.thorough
def test_motion() -> None:
    check(system(), NAMES)


@pytest.mark.thorough
def test_native(native) -> None:
    check_native(system(), NAMES)


@pytest.mark.thorough
def test_plies_and_paths() -> None:
    """Failure, smooth and exact largest curvature and divergence."""

    def number(system: mbd.System, designs: dict[str, Tensor], **options) -> Tensor:
        motion = mbd.simulate(system, 0.02, designs=designs, **(STEPS | options))
        paths = [
            mbd.fibers.FiberCurvature("rod"),
            mbd.fibers.FiberDivergence("rod"),
            mbd.fibers.FiberCurvature("rod", 30.0),
        ]
        return mbd.Final(mbd.PlyFailure("rod"))(motion) + sum((m(motion) for m in paths), torch.zeros(()))

    check(system(), NAMES, number)
