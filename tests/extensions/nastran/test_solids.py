"""Linear solids: rigid motions, the patch test on distorted elements, bending of a row of bricks."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from torchmbd.extensions.nastran.solids import _BRICK, _SIDES, solid_matrices

E, NU = 70e9, 0.3


def elasticity() -> torch.Tensor:
    D = torch.zeros(6, 6, dtype=torch.float64)
    lame, G = E * NU / ((1 + NU) * (1 - 2 * NU)), E / (2 * (1 + NU))
    D[:3, :3] = lame + 2 * G * torch.eye(3, dtype=torch.float64)
    D[range(3, 6), range(3, 6)] = G
    return D


WEDGE = torch.tensor([[0, 0, -1], [1, 0, -1], [0, 1, -1], [0, 0, 1], [1, 0, 1], [0, 1, 1]], dtype=torch.float64)
TETRA = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)


def with_sides(corners: torch.Tensor, nodes: int) -> torch.Tensor:
    """Corners, and nodes in the middles of the sides, moved a little: curved sides."""
    middle = torch.stack([(corners[i] + corners[j]) / 2 for i, j in _SIDES[nodes]])
    g = torch.Generator().manual_seed(2)
    return torch.cat([corners, middle + 0.02 * torch.rand(middle.shape, generator=g, dtype=torch.float64)])


SOLIDS = {"tetra": TETRA, "wedge": WEDGE, "brick": _BRICK}
SOLIDS |= {"tetra10": with_sides(TETRA, 10), "wedge15": with_sides(WEDGE, 15), "brick20": with_sides(_BRICK, 20)}


@pytest.mark.parametrize(
    ("corners", "nodes"), [(TETRA, 10), (WEDGE, 15), (_BRICK, 20)], ids=["tetra", "wedge", "brick"]
)
def test_quadratic_fields_are_exact(corners, nodes):
    """With straight sides: the energy of a quadratic field, whose strains are linear, over a distorted element."""
    g = torch.Generator().manual_seed(3)
    A = torch.eye(3, dtype=torch.float64) + 0.2 * torch.rand(3, 3, generator=g, dtype=torch.float64)
    x = torch.cat([corners, torch.stack([(corners[i] + corners[j]) / 2 for i, j in _SIDES[nodes]])]) @ A.T
    K, shares, _ = solid_matrices(x[None], elasticity())
    assert float(shares.min()) > 0.0
    u = torch.stack([0.3 * x[:, 0] * x[:, 1] + 0.1 * x[:, 2] ** 2, 0.2 * x[:, 1] * x[:, 2], -0.4 * x[:, 0] ** 2], 1)
    y, weight = rule(corners)
    a, b, c = (y @ A.T).unbind(1)
    e = torch.stack([0.3 * b, 0.2 * c, 0.0 * a, 0.3 * a, 0.2 * b, 0.2 * c - 0.8 * a], 1)
    expected = (weight * ((e @ elasticity()) * e).sum(1)).sum() * torch.linalg.det(A)
    assert_close(u.flatten() @ K[0] @ u.flatten(), expected, rtol=1e-10, atol=0.0)


def rule(corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Points and weights that integrate polynomials of degree two over a reference element."""
    if len(corners) == 8:
        r = torch.tensor([-1.0, 1.0], dtype=torch.float64) / 3.0**0.5
        y = torch.cartesian_prod(r, r, r)
        weight = torch.ones(8, dtype=torch.float64)
    elif len(corners) == 6:
        flat = torch.tensor([[0.5, 0.0], [0.5, 0.5], [0.0, 0.5]], dtype=torch.float64)
        r = torch.tensor([-1.0, 1.0], dtype=torch.float64) / 3.0**0.5
        y = torch.cat([torch.cat([flat, t.expand(3, 1)], 1) for t in r])
        weight = torch.full((6,), 1.0 / 6.0, dtype=torch.float64)
    else:
        middle = torch.stack([(corners[i] + corners[j]) / 2 for i in range(4) for j in range(i)])
        y = torch.cat([corners, middle])
        weight = torch.tensor([-1 / 120] * 4 + [1 / 30] * 6, dtype=torch.float64)
    return y, weight


@pytest.mark.parametrize("place", SOLIDS.values(), ids=SOLIDS)
def test_linear_fields_are_exact(place):
    """Forces of a linear field do the work of its constant stress, on a distorted element; rigid motions have none."""
    g = torch.Generator().manual_seed(1)
    size = 0.15 if len(place) <= 8 else 0.02
    x = place + size * torch.rand(place.shape, generator=g, dtype=torch.float64)
    K, volumes, _ = solid_matrices(x[None], elasticity())
    H = torch.rand(3, 3, generator=g, dtype=torch.float64)
    u = (x @ H.T).flatten()
    e = torch.stack([H[0, 0], H[1, 1], H[2, 2], H[0, 1] + H[1, 0], H[1, 2] + H[2, 1], H[2, 0] + H[0, 2]])
    assert_close(u @ K[0] @ u, volumes.sum() * (e @ elasticity() @ e), rtol=1e-12, atol=0.0)
    spin = torch.tensor([[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]], dtype=torch.float64)
    assert float((K[0] @ (x @ spin.T + 1.0).flatten()).abs().max()) < 1e-11 * float(K.abs().max())
    assert int((torch.linalg.eigvalsh(K[0]) > 1e-9 * K.abs().max()).sum()) == 3 * len(x) - 6


def test_bricks_bend():
    """Ten bricks in a row, clamped: the deflection of a slender beam (within 2 %, without incompatible modes 40 % less)."""
    L, h, n = 1.0, 0.05, 10
    line = torch.linspace(0.0, L, n + 1, dtype=torch.float64)
    section = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=torch.float64) * h
    x = torch.cat([line[:, None, None].expand(-1, 4, 1), section.expand(n + 1, 4, 2)], 2).reshape(-1, 3)
    cells = torch.tensor([[4 * k + i for i in range(8)] for k in range(n)])
    turned = cells[:, [0, 1, 2, 3, 4, 5, 6, 7]]
    K, _, volume = solid_matrices(x[turned], elasticity())
    assert (volume > 0).all()
    full = torch.zeros(len(x) * 3, len(x) * 3, dtype=torch.float64)
    for nodes, own in zip(turned, K, strict=True):
        rows = (3 * nodes[:, None] + torch.arange(3)).flatten()
        full[rows[:, None], rows] += own
    load = torch.zeros(len(full), dtype=torch.float64)
    load[-12 + 2 :: 3] = 0.25
    u = torch.linalg.solve(full[12:, 12:], load[12:])
    assert float(u[-1]) == pytest.approx(L**3 / (3 * E * h**4 / 12), rel=0.02)
