"""Recorded functions against the functions themselves, on other numbers than those of the record."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from torchmbd.numerics.recorded import Recorded, Unrepeatable


def numbers(seed: int) -> list[Tensor]:
    make = torch.Generator().manual_seed(seed)
    return [torch.randn(4, 3, 5, generator=make, dtype=torch.float64) for _ in range(2)]


def check(f, seeds=(1, 2, 3)) -> None:
    x = numbers(0)
    recorded = Recorded(lambda: f(*x), x)
    for seed in seeds:
        new = numbers(seed)
        for mine, other in zip(x, new, strict=True):
            mine.copy_(other)
        for found, expected in zip(recorded(), f(*new), strict=True):
            assert_close(found, expected, rtol=1e-13, atol=1e-13)


CONSTANT = torch.arange(12, dtype=torch.float64).reshape(3, 4)


def in_place(a: Tensor, b: Tensor) -> list[Tensor]:
    full = a.new_zeros(4, 6, 5)
    full[:, :3] = a
    full[:, 3:].addcmul_(a, b, value=2.0)
    full.add_(1.0)
    return [full, full.sum(1)]


def twice(a: Tensor, b: Tensor) -> list[Tensor]:
    """The same operation before and after one of its arguments changed."""
    first = a * b
    c = a.clone()
    second = c * b
    c.mul_(3.0)
    return [first, second, c * b]


FUNCTIONS = {
    "elementwise": lambda a, b: [(a * b + 2.0).sin() / (1.0 + a * a), torch.where(a > b, a, b), (-a).clamp(-0.5, 0.5)],
    "views": lambda a, b: [a.transpose(0, 1)[1:, ::2] @ b[0].T, a.flatten(0, 1).unflatten(0, (6, 2))[:, 1] + 1.0],
    "products": lambda a, b: [CONSTANT.T @ a[0], torch.einsum("ijk,ljk->il", a, b), torch.linalg.cross(a, b, dim=1)],
    "gathered": lambda a, b: [
        a.index_select(1, torch.tensor([2, 0, 0])),
        torch.cat([a, b], 1),
        a[:, [0, 2]],
        a.amax(0),
    ],
    "solved": lambda a, b: [torch.linalg.inv_ex(a[0] @ a[0].T)[0] @ b[0], *torch.linalg.lu_factor_ex(a[0, :, :3])[:1]],
    "constants": lambda a, b: [
        a + torch.eye(3, dtype=a.dtype)[:, :1] + torch.full((1, 5), 2.0, dtype=a.dtype),
        b.new_zeros(2),
    ],
    "empty": lambda a, b: [torch.cat([a[:0], b]), a[:0].sum(0) + b[0]],
    "masks": lambda a, b: [
        torch.where(a > 0.0, a, b),
        torch.where(a > 0.0, b, a),
        a[:, torch.tensor([True, False, True])],
    ],
    "places": lambda a, b: [b.gather(1, a.argmax(1, keepdim=True)), a.gather(1, a.argmax(1, keepdim=True))],
    "an input": lambda a, b: [a, b[0]],
    "in place": in_place,
    "twice": twice,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_other_numbers(name):
    check(FUNCTIONS[name])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("+*-cfs"), st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=25))
def test_any_chain_of_operations(chain):
    """Memory is used again as soon as nobody reads it any more, and no sooner."""

    def f(a: Tensor, b: Tensor) -> list[Tensor]:
        known = [a, b]
        for op, i, j in chain:
            x, y = known[i % len(known)], known[j % len(known)]
            if op in "+*-":
                known.append({"+": torch.add, "*": torch.mul, "-": torch.sub}[op](x, y).tanh())
            else:
                known.append({"c": x.clone().add_(y), "f": x.flip(0), "s": x.sum(0, keepdim=True) - y}[op])
        return known[-3:]

    check(f, seeds=(1,))


def test_memory_is_used_again():
    x = torch.ones(1000, dtype=torch.float64)

    def f() -> list[Tensor]:
        y = x
        for _ in range(50):
            y = y + 1.0
        return [y]

    recorded = Recorded(f, [x])
    assert recorded.results[0].untyped_storage().nbytes() < 4 * 8 * 1024
    assert_close(recorded()[0], x + 50.0)


def test_what_cannot_be_repeated():
    x = torch.ones(3, dtype=torch.float64)
    outside = torch.zeros(3, dtype=torch.float64)
    for f in (
        lambda: [x * 2.0 if x.sum() > 0.0 else x],
        lambda: [x + torch.rand(3, dtype=x.dtype) * x],
        lambda: [outside.add_(x)],
        lambda: [x * float(x.numpy()[0])],
        lambda: [x * x.tolist()[0]],
        lambda: [outside.add_(1.0), x * 2.0],
        lambda: [x[x > 0.0]],
        lambda: [(x > 0.0).nonzero() * x.sum()],
    ):
        with pytest.raises(Unrepeatable):
            Recorded(f, [x])
    assert_close(Recorded(lambda: [x * float(CONSTANT.sum())], [x])()[0], x * 66.0)  # a constant may be asked for


def test_no_compiler_of_torch_is_imported():
    import subprocess
    import sys

    code = (
        "import sys, torch; from torchmbd.numerics.recorded import Recorded; x = torch.ones(2, dtype=torch.float64);"
        "Recorded(lambda: [x * x], [x])(); sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
