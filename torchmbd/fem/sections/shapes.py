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

_CORNERS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


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


def shape(nodes: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """Shape functions [g, nodes] and their natural derivatives [g, nodes, 2] at points [g, 2]."""
    x, y = points[:, 0], points[:, 1]
    return {3: _triangle, 6: _quadratic_triangle, 4: _quadrilateral, 8: _serendipity}[nodes](x, y)


def _triangle(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    unit = torch.ones_like(x)
    N = torch.stack([unit - x - y, x, y], dim=-1)
    dN = torch.tensor([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]], dtype=x.dtype).expand(len(x), 3, 2)
    return N, dN


def _quadratic_triangle(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    L, dL = _triangle(x, y)
    N, dN = [], []
    for i in range(3):
        N.append(L[:, i] * (2 * L[:, i] - 1))
        dN.append((4 * L[:, i] - 1)[:, None] * dL[:, i])
    for i, j in ((0, 1), (1, 2), (2, 0)):
        N.append(4 * L[:, i] * L[:, j])
        dN.append(4 * (L[:, i, None] * dL[:, j] + L[:, j, None] * dL[:, i]))
    return torch.stack(N, dim=-1), torch.stack(dN, dim=1)


def _quadrilateral(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    N, dN = [], []
    for a, b in _CORNERS:
        N.append((1 + a * x) * (1 + b * y) / 4)
        dN.append(torch.stack([a * (1 + b * y) / 4, b * (1 + a * x) / 4], dim=-1))
    return torch.stack(N, dim=-1), torch.stack(dN, dim=1)


def _serendipity(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    N, dN = [], []
    for a, b in _CORNERS:
        N.append((1 + a * x) * (1 + b * y) * (a * x + b * y - 1) / 4)
        dx = a * (1 + b * y) * (2 * a * x + b * y) / 4
        dy = b * (1 + a * x) * (a * x + 2 * b * y) / 4
        dN.append(torch.stack([dx, dy], dim=-1))
    for a, b in ((0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)):
        if a == 0.0:
            N.append((1 - x * x) * (1 + b * y) / 2)
            dN.append(torch.stack([-x * (1 + b * y), b * (1 - x * x) / 2], dim=-1))
        else:
            N.append((1 - y * y) * (1 + a * x) / 2)
            dN.append(torch.stack([a * (1 - y * y) / 2, -y * (1 + a * x)], dim=-1))
    return torch.stack(N, dim=-1), torch.stack(dN, dim=1)
