"""Shape functions and quadrature of the section's elements: triangles and quadrilaterals, linear and quadratic.

    3, 4   corners                                              triangle, bilinear quadrilateral
    6, 8   corners, then the middles of the sides 12, 23, ...   quadratic triangle, serendipity quadrilateral

Natural coordinates: triangles (xi, eta) from corner 1; quadrilaterals in [-1, 1]^2. Rules integrate the products of
two shape functions on an undistorted element exactly.
Source: O. C. Zienkiewicz and R. L. Taylor, The Finite Element Method, vol. 1, chapter 8; triangle rules: D. A. Dunavant,
Int. J. Numer. Methods Eng. 21 (1985) 1129-1148.
Checked in tests/fem/sections/test_shapes.py.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmbd.fem.shape_functions import serendipity_powers, shape_functions, simplex_powers


def rule(nodes: int) -> tuple[Tensor, Tensor]:
    """Points [g, 2] and weights [g] of the element with so many nodes."""
    if nodes == 3:
        p = torch.tensor([[1 / 6, 1 / 6], [2 / 3, 1 / 6], [1 / 6, 2 / 3]], dtype=torch.float64)
        return p, torch.full((3,), 1 / 6, dtype=torch.float64)
    if nodes == 6:
        points, weights = [], []
        for a, w in ((0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322)):
            points += [(a, a), (1 - 2 * a, a), (a, 1 - 2 * a)]
            weights += [w / 2] * 3
        return torch.tensor(points, dtype=torch.float64), torch.tensor(weights, dtype=torch.float64)
    r = math.sqrt(1 / 3) if nodes == 4 else math.sqrt(0.6)
    line = [(-r, 1.0), (r, 1.0)] if nodes == 4 else [(-r, 5 / 9), (0.0, 8 / 9), (r, 5 / 9)]
    points = [(x, y) for x, _ in line for y, _ in line]
    weights = [u * v for _, u in line for _, v in line]
    return torch.tensor(points, dtype=torch.float64), torch.tensor(weights, dtype=torch.float64)


def corners(nodes: int) -> Tensor:
    """Corners of the element with so many nodes, natural coordinates [3 or 4, 2]."""
    places = (
        ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
        if nodes in (3, 6)
        else ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    )
    return torch.tensor(places, dtype=torch.float64)


def shape(nodes: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """Shape functions [g, nodes] and their natural derivatives [g, nodes, 2] at points [g, 2]."""
    degree, x = 1 if nodes in (3, 4) else 2, corners(nodes)
    powers = simplex_powers(degree) if nodes in (3, 6) else serendipity_powers(degree, 2)
    places = x if degree == 1 else torch.cat([x, (x + x.roll(-1, 0)) / 2.0])
    return shape_functions(places, powers, points)
