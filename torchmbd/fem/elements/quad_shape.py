"""Bilinear map of a quadrilateral: places, areas and slopes of the shape functions at natural coordinates.

    x(xi, eta) = sum_i N_i x_i,      N_i = (1 + xi_i xi)(1 + eta_i eta) / 4,      corners (-1, -1), (1, -1), (1, 1), (-1, 1)

`gauss` gives the 2 x 2 points, which integrate quadratic fields over any quadrilateral exactly.
Source: O. C. Zienkiewicz and R. L. Taylor, The Finite Element Method, vol. 1, chapters 8 and 9.
Checked in tests/fem/elements/test_quad.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

XI = torch.tensor([-1.0, 1.0, 1.0, -1.0], dtype=torch.float64)
ETA = torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64)


class Bilinear(NamedTuple):
    """The map at points (xi, eta) [p] of every cell.

    shape     N_i   [p, 4]
    position     [m, p, 2], m
    jacobian  rows d/dxi, d/deta of (x, y)   [m, p, 2, 2], m
    weight    determinants: with the 2 x 2 rule the areas that the points stand for   [m, p], m2
    slopes    d/dx, d/dy of N_i   [m, p, 2, 4], 1/m
    """

    xi: Float[Tensor, " p"]
    eta: Float[Tensor, " p"]
    shape: Float[Tensor, "p 4"]
    position: Float[Tensor, "m p 2"]
    jacobian: Float[Tensor, "m p 2 2"]
    weight: Float[Tensor, "m p"]
    slopes: Float[Tensor, "m p 2 4"]


def bilinear(corners: Float[Tensor, "m 4 2"], xi: Float[Tensor, " p"], eta: Float[Tensor, " p"]) -> Bilinear:
    """Return the map at given points."""
    along, across = 1.0 + xi[:, None] * XI, 1.0 + eta[:, None] * ETA
    natural = 0.25 * torch.stack([XI * across, ETA * along], dim=1)  # [p, 2, 4]
    jacobian = torch.einsum("pai,mic->mpac", natural, corners)
    slopes = torch.linalg.solve(jacobian, natural.expand(len(corners), -1, -1, -1))
    shape = 0.25 * along * across
    position = torch.einsum("pi,mic->mpc", shape, corners)
    return Bilinear(xi, eta, shape, position, jacobian, torch.linalg.det(jacobian), slopes)


def gauss(corners: Float[Tensor, "m 4 2"]) -> Bilinear:
    """Return the map at the 2 x 2 points of Gauss, each beside its corner."""
    return bilinear(corners, XI / 3.0**0.5, ETA / 3.0**0.5)


def middle(corners: Float[Tensor, "m 4 2"]) -> Bilinear:
    """Return the map at xi = eta = 0."""
    zero = torch.zeros(1, dtype=torch.float64)
    return bilinear(corners, zero, zero)
