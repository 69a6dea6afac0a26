"""Selected rows beside those of torch's own indexing."""

import pytest
import torch

from torchmbd.math.pull_back import pull_back
from torchmbd.math.row_selection import lanes_first, select_rows
from torchmbd.math.threads import GROUP

ROWS = [4, 1, 2]


def numbers(pair: int, lanes: int = GROUP + 3) -> torch.Tensor:
    make = torch.Generator().manual_seed(0)
    return torch.randn(6, 5, pair, lanes, generator=make, dtype=torch.float64).requires_grad_()


@pytest.mark.parametrize("rows", [ROWS, torch.tensor(ROWS), [2, 2, 0]])
@pytest.mark.parametrize("pair", [1, 3])
def test_rows_and_their_cotangents(rows, pair):
    x = numbers(pair)
    y, expected = select_rows(x, rows), x[:, list(rows)]
    assert torch.equal(y, expected)
    weights = torch.randn(2, *y.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (by_x,) = pull_back([y], [x], [weights])
    assert torch.equal(by_x, pull_back([expected], [x], [weights])[0])


def test_lanes_first_is_contiguous_and_its_cotangents_need_no_copy():
    x = numbers(1)
    y = lanes_first(select_rows(x, ROWS))
    assert y.is_contiguous()
    assert torch.equal(y, x[:, ROWS, 0].permute(2, 0, 1))
    weights = torch.randn(2, *y.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (by_x,) = pull_back([y], [x], [weights])
    assert torch.equal(by_x, pull_back([x[:, ROWS, 0].permute(2, 0, 1)], [x], [weights])[0])
    assert by_x.movedim(0, 2).is_contiguous()  # as the adjoint of a motion takes them


@pytest.mark.parametrize("function", [lambda x: select_rows(x, ROWS), lambda x: lanes_first(select_rows(x, ROWS))])
def test_derivatives_of_any_order(function):
    x = numbers(1, lanes=2)
    assert torch.autograd.gradcheck(function, (x,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(function, (x,))
    torch.testing.assert_close(torch.func.vmap(function)(x.detach()[None].expand(2, -1, -1, -1, -1))[1], function(x))
