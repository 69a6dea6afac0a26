"""Shape functions: polynomials they must hold exactly, derivatives against differences; rules against exact integrals."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from torchmbd.fem.sections.shapes import rule, shape

CORNERS = {3: [(0, 0), (1, 0), (0, 1)], 4: [(-1, -1), (1, -1), (1, 1), (-1, 1)]}


def places(nodes):
    corners = torch.tensor(CORNERS[3 if nodes in (3, 6) else 4], dtype=torch.float64)
    return corners if nodes in (3, 4) else torch.cat([corners, (corners + corners.roll(-1, 0)) / 2])


@pytest.mark.parametrize("nodes", [3, 4, 6, 8])
def test_each_function_is_one_at_its_node(nodes):
    assert_close(shape(nodes, places(nodes))[0], torch.eye(nodes, dtype=torch.float64))


@pytest.mark.parametrize(("nodes", "degree"), [(3, 1), (4, 1), (6, 2), (8, 2)])
def test_polynomials_are_held(nodes, degree):
    points = torch.rand(7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.5
    N, dN = shape(nodes, points)
    x, y = places(nodes).unbind(1)
    u, v = points.unbind(1)
    for i in range(degree + 1):
        for j in range(degree + 1 - i):
            assert_close(N @ (x**i * y**j), u**i * v**j, rtol=0, atol=1e-14)
            slope = torch.einsum("gkd,k->gd", dN, x**i * y**j)
            along = torch.stack([i * u ** max(i - 1, 0) * v**j, j * u**i * v ** max(j - 1, 0)], dim=1)
            assert_close(slope, along, rtol=0, atol=1e-13)


@pytest.mark.parametrize("nodes", [3, 4, 6, 8])
def test_derivatives_against_differences(nodes):
    points = torch.rand(5, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 0.5
    h = torch.eye(2, dtype=torch.float64) * 1e-6
    rough = torch.stack([(shape(nodes, points + e)[0] - shape(nodes, points - e)[0]) / 2e-6 for e in h], dim=-1)
    assert_close(shape(nodes, points)[1], rough, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("nodes", "degree"), [(3, 2), (4, 3), (6, 4), (8, 5)])
def test_rules_are_exact(nodes, degree):
    points, weights = rule(nodes)
    factorial = [1, 1, 2, 6, 24, 120, 720, 5040]
    for i in range(degree + 1):
        for j in range(degree + 1 - i):
            value = float((weights * points[:, 0] ** i * points[:, 1] ** j).sum())
            if nodes in (3, 6):
                exact = factorial[i] * factorial[j] / factorial[i + j + 2]
            else:
                exact = 0.0 if i % 2 or j % 2 else 4 / ((i + 1) * (j + 1))
            assert value == pytest.approx(exact, abs=1e-14)
