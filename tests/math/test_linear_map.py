"""A linear map and its derivatives, and sums of chosen numbers, beside the same products written with matrices."""

from __future__ import annotations

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck
from torch.func import jacfwd, jacrev, jvp, vmap
from torch.testing import assert_close

from torchmbd.math.linear_map import Sums, apply_linear

GENERATOR = torch.Generator().manual_seed(3)
P, Q, X, Y = (
    torch.randn(*shape, generator=GENERATOR, dtype=torch.float64) for shape in ((4, 3), (5, 3), (2, 4), (2, 5))
)


class Sum:
    """x P + y Q."""

    def __call__(self, *x):
        return x[0] @ P + x[1] @ Q

    def adjoint(self, y):
        return y @ P.T, y @ Q.T


def cubes(x, y):
    return apply_linear(Sum(), x**3, (x.sum() * y) ** 2)


def plain(x, y):
    return x**3 @ P + (x.sum() * y) ** 2 @ Q


@pytest.mark.thorough
def test_all_modes_of_derivatives():
    for way in (jacfwd, jacrev):
        for own, other in zip(way(cubes, (0, 1))(X, Y), way(plain, (0, 1))(X, Y), strict=True):
            assert_close(own, other)
    assert_close(jacfwd(jacrev(cubes))(X, Y), jacfwd(jacrev(plain))(X, Y))
    inputs = [t.clone().requires_grad_() for t in (X, Y)]
    assert gradcheck(cubes, inputs, check_forward_ad=True)
    assert gradgradcheck(cubes, inputs)


def test_lanes_of_lanes_where_only_one_of_the_two_has_them():
    several = torch.stack([X, 2 * X, -X])
    assert_close(vmap(lambda x: cubes(x, Y))(several), torch.stack([plain(x, Y) for x in several]))
    pushed = vmap(lambda t: jvp(lambda x: cubes(x, Y), (X,), (t,))[1])(several)
    assert_close(pushed, torch.stack([jvp(lambda x: plain(x, Y), (X,), (t,))[1] for t in several]))


def test_members_of_a_batch_that_follow_the_lanes_in_memory_are_not_copied():
    places = []

    class Noted(Sum):
        def __call__(self, *x):
            places.extend(t.data_ptr() for t in x)
            return super().__call__(*x)

    x, y = (torch.stack([t, 2 * t, -t], 1) for t in (X, Y))  # [lane, member, :]
    result = vmap(lambda x, y: apply_linear(Noted(), x, y), in_dims=1)(x, y)
    assert places == [x.data_ptr(), y.data_ptr()]
    assert_close(result, torch.stack([x[:, k] @ P + y[:, k] @ Q for k in range(3)]))


ROWS, TERMS = torch.tensor([4, 0, 0, 2, 4, 4, 2]), torch.tensor([1, 3, 3, 0, 2, 1, 5])
MATRIX = torch.zeros(6, 7, dtype=torch.float64).index_put((ROWS, TERMS), torch.ones(7).double(), accumulate=True)


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(sum(shape)))


@pytest.mark.usefixtures("products")
def test_the_map_and_its_transpose() -> None:
    sums, x, y = Sums.of(ROWS, TERMS, (6, 7)), random(3, 7), random(3, 6)
    torch.testing.assert_close(sums(x), x @ MATRIX.T)
    torch.testing.assert_close(sums.adjoint(y)[0], y @ MATRIX)
