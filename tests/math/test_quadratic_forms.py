"""Sums of quadratic forms: compiled and torch, values and derivatives, against their definition."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchmbd.math import quadratic_forms as module
from torchmbd.math.quadratic_forms import factors, matrices, quadratic_forms


def numbers(lanes: int, k: int, points: int, r: int, s: int, a: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    law = torch.randn(lanes, k, points, r, r, generator=generator, dtype=torch.float64)
    return law + law.mT, torch.randn(lanes, points, r, s, a, generator=generator, dtype=torch.float64)


def of_matrices(law: Tensor, d: Tensor) -> Tensor:
    return quadratic_forms(factors(law), d)


def defined(law: Tensor, d: Tensor) -> Tensor:
    return torch.einsum("...kpij,...pisa,...pjsb->...kab", law, d, d)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("sizes", [(2, 3, 70, 2, 3, 8), (1, 14, 5, 9, 1, 3), (3, 1, 1, 1, 2, 11)])
def test_values_and_derivatives(sizes, compiled, monkeypatch, request):
    if compiled:
        request.getfixturevalue("compiled")
    else:
        monkeypatch.setattr(module, "compiled_products", lambda x: None)
    law, d = numbers(*sizes)
    assert_close(of_matrices(law, d), defined(law, d), rtol=1e-12, atol=1e-11)
    other = numbers(*sizes)[1].flip(0) + 1.0
    tangents = (law.roll(1, 2), other)
    for f in (of_matrices, defined):
        _, out = torch.func.jvp(f, (law, d), tangents)
        y, back = torch.func.vjp(f, law, d)
        slopes = back(y.cos())
        if f is of_matrices:
            result = (out, *slopes)
        else:
            assert_close(result[0], out, rtol=1e-11, atol=1e-10)
            assert_close(0.5 * (result[1] + result[1].mT), 0.5 * (slopes[0] + slopes[0].mT), rtol=1e-11, atol=1e-10)
            assert_close(result[2], slopes[1], rtol=1e-11, atol=1e-10)


def test_lanes_are_broadcast_and_batched():
    law, d = numbers(2, 3, 4, 2, 3, 5)
    assert_close(of_matrices(law, d[0]), defined(law, d[0].expand_as(d)))
    assert_close(of_matrices(law[0], d), defined(law[0].expand_as(law), d))
    assert_close(torch.vmap(of_matrices)(law[:, None], d[:, None])[:, 0], defined(law, d))
    rows = torch.func.jacrev(lambda x: of_matrices(law, x)[0, 0, 0])(d)
    assert_close(rows, torch.func.jacfwd(lambda x: of_matrices(law, x)[0, 0, 0])(d))


def test_factors_hold_the_matrices():
    law, _ = numbers(2, 3, 4, 3, 1, 1)
    assert_close(matrices(factors(law), 3), law, rtol=0.0, atol=0.0)
