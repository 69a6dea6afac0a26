"""Functions of groups of lanes beside the same functions of all lanes at once."""

import pytest
import torch

import torchmbd as mbd
from torchmbd.math.lane_groups import by_groups
from torchmbd.math.pull_back import pull_back
from torchmbd.math.threads import GROUP

LANES = 2 * GROUP + 5


def function(x: torch.Tensor, A: torch.Tensor) -> tuple[torch.Tensor, ...]:
    y = torch.einsum("lij,lj->li", A, x)
    return y.sin(), y.square().sum(-1), x.detach()


def tensors() -> tuple[torch.Tensor, torch.Tensor]:
    make = torch.Generator().manual_seed(0)
    x, A = (torch.randn(LANES, *shape, generator=make, dtype=torch.float64) for shape in ((3,), (4, 3)))
    return x.requires_grad_(), A.requires_grad_()


def by_group(x: torch.Tensor, A: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return by_groups(function, x, A)


def at_once(x: torch.Tensor, A: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return function(x, A)


def test_values_and_rows_of_gradients_are_those_of_all_lanes_at_once():
    x, A = tensors()
    make = torch.Generator().manual_seed(1)
    rows = [torch.randn(2, *y.shape, generator=make, dtype=torch.float64) for y in function(x, A)[:2]]
    for of_rows in (rows, [y[:1] for y in rows]):
        each = []
        for f in (by_group, at_once):
            y = f(x, A)
            each.append([*y, *pull_back(y[:2], [x, A], of_rows), *pull_back(y[1:2], [A], of_rows[1:])])
        for a, b in zip(*each, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)


def test_a_tensor_without_gradient_takes_no_part_in_the_backward_pass():
    x, A = tensors()
    y = by_groups(function, x, A.detach())[1]
    (by_x,) = torch.autograd.grad(y.sum(), [x])
    torch.testing.assert_close(by_x, torch.autograd.grad(function(x, A.detach())[1].sum(), [x])[0])
    assert not by_groups(function, x.detach(), A.detach())[0].requires_grad


def test_any_number_of_threads_gives_the_same_bits():
    results = []
    for count in (1, 2, 3):
        x, A = tensors()
        with mbd.threads(count):
            y = by_groups(function, x, A)
            results.append([*y, *torch.autograd.grad(y[0].sum() + y[1].sum(), [x, A])])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_forward_mode_and_transforms_of_torch():
    x, A = (y.detach() for y in tensors())
    for f in (by_group, at_once):
        dy = torch.func.jvp(lambda x, f=f: f(x, A)[1], (x,), (x,))[1]
        torch.testing.assert_close(dy, 2 * function(x, A)[1])
    torch.testing.assert_close(
        torch.func.vmap(lambda k: by_group(k * x, A)[1])(torch.ones(2)), function(x, A)[1].expand(2, -1)
    )
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(x, x)
        tangent = torch.autograd.forward_ad.unpack_dual(by_group(dual, A)[1]).tangent
        torch.testing.assert_close(tangent, 2 * function(x, A)[1])


def test_second_derivatives_are_refused():
    x, A = tensors()
    (by_x,) = torch.autograd.grad(by_group(x, A)[1].sum(), [x], create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        torch.autograd.grad(by_x.sum(), [x])


def test_the_error_of_a_lane_reaches_the_caller():
    def fails(x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        raise ValueError("no value")

    with pytest.raises(ValueError, match="no value"):
        by_groups(fails, tensors()[0])


def test_one_lane_for_all_is_broadcast():
    x, A = tensors()
    assert torch.equal(by_group(x, A[:1])[1], function(x, A[:1])[1])
