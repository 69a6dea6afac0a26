"""Modes keep their place and sign along a design change that lets eigenvalues cross."""

import pytest
import torch

from torchmbd.errors import InputError
from torchmbd.reduction import align, modal_basis, span

MASS = torch.linspace(1, 2, 6, dtype=torch.float64)


def crossing(b: float) -> torch.Tensor:
    """M-orthonormal modes whose eigenvalues 2 + b and 2 - b cross at b = 0; modes turn slowly with b."""
    make = torch.Generator().manual_seed(2)
    W, start = (torch.randn(6, 6, generator=make, dtype=torch.float64) for _ in range(2))
    Q = torch.linalg.matrix_exp(0.2 * b * (W - W.T)) @ torch.linalg.qr(start)[0]
    root = MASS.sqrt()
    values = torch.tensor([1.0, 2 + b, 2 - b, 4.0, 5.0, 6.0], dtype=torch.float64)
    return root[:, None] * ((Q * values) @ Q.T) * root


def test_shapes_stay_at_their_place_through_a_crossing():
    modes = modal_basis(crossing(-0.1), MASS, 3).vectors
    for b in (-0.05, 0.05, 0.1):
        found = align(modes, modal_basis(crossing(b), MASS, 3).vectors, MASS)
        assert found.assurance.min() > 0.95
        assert ((modes * MASS[:, None] * found.vectors).sum(0) > 0.97).all()
        assert found.order.tolist() == ([0, 2, 1] if b > 0 else [0, 1, 2])
        modes = found.vectors


def test_signs_and_order_are_undone_exactly():
    modes = modal_basis(crossing(0.3), MASS, 4).vectors
    shuffled = -modes[:, [2, 0, 3, 1]]
    found = align(modes, shuffled, MASS)
    assert found.order.tolist() == [1, 3, 0, 2]
    torch.testing.assert_close(found.vectors, modes)
    torch.testing.assert_close(found.assurance, torch.ones(4, dtype=torch.float64))


def test_a_turned_span_is_turned_back():
    modes = modal_basis(crossing(0.3), MASS, 3).vectors
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    torch.testing.assert_close(modes @ turn @ span(modes, modes @ turn, MASS), modes)


def test_wrong_shapes_are_named():
    with pytest.raises(InputError, match="have shapes"):
        align(torch.zeros(6, 3).double(), torch.zeros(6, 2).double(), MASS)
