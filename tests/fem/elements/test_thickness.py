"""Thicknesses as design variables: exact derivatives, and how far the element's two constants may stay behind."""

import pytest
import torch
from torch.func import functional_call, jacfwd
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, irregular

ANGLES, HEIGHT = mbd.deg([20, -50, 75]), 2.5e-3


class Frequencies(torch.nn.Module):
    """Eigenvalues of the reduced stiffness [1/s2] of a cantilever, unbalanced, on an irregular mesh."""

    def __init__(self, height: float):
        super().__init__()
        laminate = mbd.Laminate(CARBON, ANGLES, torch.tensor([0.2, 0.5, 0.3]) * height)
        mesh = irregular(0.304, 0.08, (12, 4))
        self.body = mbd.FlexibleBody.plate("plate", mesh, laminate, modes=5, reference="left_edge")

    def forward(self):
        return torch.linalg.eigvalsh(self.body.structure()["Kr"])

    def at(self, thickness):
        return functional_call(self, {"body.laminate.thickness": thickness})


@pytest.fixture(scope="module")
def given():
    return Frequencies(HEIGHT)


def test_derivative_by_every_thickness_against_differences(given):
    """Through stiffness, mass and modes."""
    h = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64) * HEIGHT
    exact = jacfwd(given.at)(h)
    for k, e in enumerate(torch.eye(3, dtype=torch.float64) * 1e-4 * HEIGHT):
        near, far = given.at(h + e) - given.at(h - e), given.at(h + 2 * e) - given.at(h - 2 * e)
        rough = ((8 * near - far) / (12e-4 * HEIGHT)).detach()
        assert_close(exact[:, k], rough, rtol=1e-6, atol=0)


@pytest.mark.parametrize(("ratio", "error"), [(0.5, 0.005), (0.8, 0.002), (1.2, 0.002), (2.0, 0.02)])
def test_constants_of_a_neighboring_thickness(ratio, error, given):
    """Frequencies beside those of a body that is made for the new thickness."""
    anew = Frequencies(ratio * HEIGHT)
    moved = given.at(anew.body.laminate.thickness)
    assert_close(moved.sqrt(), anew().sqrt(), rtol=error, atol=0)
