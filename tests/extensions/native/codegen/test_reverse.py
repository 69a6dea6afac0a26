"""Reverse mode on a program: the derivatives that torch finds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.extensions.native.codegen.interpreter import Interpreter
from tests.extensions.native.codegen.test_array import BODY, FUNCTIONS, GROUP, SHAPES, SIZES, Tables, numbers, traced
from torchmbd.extensions.native.codegen.array import Array
from torchmbd.extensions.native.codegen.program import Program, Write
from torchmbd.extensions.native.codegen.reverse import Pullback
from torchmbd.extensions.native.codegen.rules import RULES
from torchmbd.extensions.native.codegen.scalars import BINARY, TERNARY, UNARY, Untraceable
from torchmbd.extensions.native.codegen.size import constant_index

TABLES = {"body": BODY, "group": [SIZES["N"] if g < 0 else g for g in GROUP]}


def pulled(program: Program, writes: list[Write], given: dict[str, Tensor], y: Tensor) -> dict[str, np.ndarray]:
    """Derivatives of y' out by all inputs."""
    program.buffer("y", 0, "lanes")
    by = {name: f"{name}_bar" for name in given}
    for name in by.values():
        program.buffer(name, 0, "output")
    result = Pullback(program, by)(writes, lambda index: program.load("y", index))
    run = Interpreter(program, SIZES, TABLES, given | {"y": y})
    return run.run(result, {by[name]: x.numel() for name, x in given.items()})


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_of_loops_are_those_of_torch(name: str) -> None:
    f, given = FUNCTIONS[name], numbers(3)
    leaves = {k: x.clone().requires_grad_() for k, x in given.items()}
    out = f(Tables(False), **leaves)
    y = torch.rand(out.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    result = pulled(*traced(f), given, y)
    expected = torch.autograd.grad(out, list(leaves.values()), y, allow_unused=True, materialize_grads=True)
    for key, x in zip(SHAPES, expected, strict=True):
        np.testing.assert_allclose(result[f"{key}_bar"], x.flatten().numpy(), rtol=1e-12, atol=1e-13, err_msg=key)


def checked(f: Callable[[Any], Any], x: Tensor, wanted: Callable[[Tensor], Tensor] | None = None) -> None:
    """Of components alone."""
    program = Program()
    out = f(Array.input(program, "x", tuple(x.shape)))
    program.buffer("out", 0, "output")
    writes = [Write("out", (), constant_index(i), n, False) for i, n in enumerate(out.numbers.ravel().tolist())]
    y = torch.randn(len(writes), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    result = torch.from_numpy(pulled(program, writes, {"x": x}, y)["x_bar"])
    jacobian: Any = torch.func.jacrev(f) if wanted is None else wanted
    assert_close(result, y @ jacobian(x).reshape(len(y), -1), rtol=1e-13, atol=1e-13)


TURNED = torch.tensor([1, 2, 0])
COMPONENTS: dict[str, Callable[[Any], Any]] = {
    "sums": lambda x: torch.stack([x[0] + x[1] - 3.0 * x[2], -x[0] - (-x[1]), x.sum()]),
    "products": lambda x: torch.stack([x[0] * x[1] * x[2], x[0] / x[1], 2.0 / x[2], x[0] * x[0]]),
    "functions": lambda x: torch.stack(
        [torch.sqrt(torch.abs(x)), torch.sin(x), torch.cos(x), torch.exp(x), torch.log(torch.abs(x)), torch.tanh(x)]
    ),
    "choices": lambda x: torch.cat(
        [
            torch.maximum(x, 0.5 * x.index_select(0, TURNED)),
            torch.clamp(x, -0.5, 0.5),
            torch.where(x > 0.2, x * x, 3.0 * x),
        ]
    ),
    "angle": lambda x: torch.atan2(x, x.index_select(0, TURNED)),
    "chain": lambda x: torch.sin(x) * torch.cos(x * x) / torch.sqrt(1.5 + torch.tanh(x)),
}


@pytest.mark.parametrize("name", COMPONENTS)
def test_derivatives_are_those_of_torch(name: str) -> None:
    for x in ([0.7, -0.4, 1.3], [-1.2, 0.3, 0.9]):
        checked(COMPONENTS[name], torch.tensor(x, dtype=torch.float64))


def test_of_two_equal_numbers_each_gets_half() -> None:
    checked(lambda x: torch.maximum(x[0], x[1])[None], torch.tensor([0.3, 0.3], dtype=torch.float64))
    checked(lambda x: torch.minimum(x[0], x[1])[None], torch.tensor([0.3, 0.3], dtype=torch.float64))


def branches(x: Any) -> Any:
    """Roots of numbers below zero, in branches that are not taken; one of them counts outside of its branch as well."""
    root, outside = torch.sqrt(x[0] - 2.0), x[1] * x[1]
    inner = torch.where(x[1] > 0.0, torch.sqrt(x[1] * outside), x[0] * torch.sqrt(x[0]))
    return torch.stack([torch.where(x[0] > 2.0, root * x[1], 3.0 * x[0]), torch.where(x[2] > 0.0, inner, outside)])


@pytest.mark.parametrize(
    "x", [[0.5, 0.3, 1.0], [-0.5, 0.3, 1.0], [0.5, -0.3, 1.0], [-0.5, -0.3, -1.0], [2.5, 0.3, 1.0]]
)
def test_a_branch_that_is_not_taken_counts_nothing(x: list[float]) -> None:
    """Where torch in reverse mode finds nan, as forward mode has it."""
    checked(branches, torch.tensor(x, dtype=torch.float64), torch.func.jacfwd(branches))


def test_every_operation_has_a_rule() -> None:
    assert set(RULES) == {*UNARY, *BINARY, *TERNARY}


def test_an_operation_without_a_rule_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(RULES, "sin")
    with pytest.raises(Untraceable, match="'sin'"):
        checked(torch.sin, torch.ones(2, dtype=torch.float64))
