"""Logarithms of rigid motions against matrix exponentials, their maps against automatic differentiation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchmbd.math.rigid_motion import (
    LARGEST,
    end_map,
    end_wrenches,
    exponential,
    hat,
    logarithm,
    rotation_vector,
    wrench_slopes,
)

ANGLES = [0.0, 1e-9, 1e-4, 0.3, 1.0, LARGEST]


def screw(angle: float) -> Tensor:
    x = torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    return torch.cat([x[:3], angle * x[3:] / x[3:].norm()])


def motion(l: Tensor) -> Tensor:
    """Of the screw, a matrix of 4 x 4."""
    top = torch.cat([hat(l[3:]), l[:3, None]], 1)
    return torch.linalg.matrix_exp(torch.cat([top, torch.zeros(1, 4, dtype=l.dtype)]))


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_inverts_the_exponential(angle):
    l = screw(angle)
    H = motion(l)
    torch.testing.assert_close(logarithm(H[:3, 3], H[:3, :3]), l, rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(rotation_vector(exponential(l[3:])), l[3:], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_maps_are_derivatives_of_the_logarithm(angle):
    l = screw(angle)

    def moved(first: Tensor, second: Tensor) -> Tensor:
        H = torch.linalg.inv(motion(first)) @ motion(l) @ motion(second)
        return logarithm(H[:3, 3], H[:3, :3])

    still = torch.zeros(6, dtype=torch.float64)
    by_first, by_second = torch.func.jacfwd(moved, (0, 1))(still, still)
    torch.testing.assert_close(end_map(l), by_second, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(-end_map(-l), by_first, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_wrenches_and_their_slopes(angle):
    l, f = screw(angle), screw(0.7).flip(0)
    first, second = end_wrenches(l, f)
    torch.testing.assert_close(first, -end_map(-l).T @ f, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(second, end_map(l).T @ f, rtol=1e-12, atol=1e-13)
    slopes = torch.func.jacfwd(lambda l: torch.cat(end_wrenches(l, f)))(l)
    torch.testing.assert_close(wrench_slopes(l, f), slopes, rtol=1e-11, atol=1e-12)
