"""Reverse mode on a tape: the derivatives that torch finds."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchmbd.numerics.reverse import RULES, pullback
from torchmbd.numerics.scalars import BINARY, TERNARY, UNARY, Tape, Untraceable


def evaluated(tape: Tape, nodes: list[int], given: dict[str, Tensor]) -> Tensor:
    """Numbers of a tape, operation by operation."""
    known: dict[int, float] = {}
    for i, (op, args) in enumerate(zip(tape.op, tape.args, strict=True)):
        if op == "constant":
            known[i] = args[0]
        elif op == "input":
            known[i] = float(given[args[0]].flatten()[args[1]])
        else:
            f = UNARY.get(op) or BINARY.get(op) or TERNARY[op]
            root_of_negative = op == "sqrt" and known[args[0]] < 0.0  # Python raises where processors say nan
            known[i] = math.nan if root_of_negative else f(*(known[a] for a in args))
    return torch.tensor([known[i] for i in nodes], dtype=torch.float64)


def checked(f: Callable[[Tensor], Tensor], x: Tensor) -> None:
    tape = Tape()
    numbers = tape.inputs("x", *x.shape)
    (outputs,) = tape.trace(f, numbers)
    weights = tape.inputs("y", outputs.size).tolist()
    found = pullback(tape, outputs.ravel().tolist(), weights, numbers.ravel().tolist())
    y = torch.randn(outputs.size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    leaf = x.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(f(leaf).flatten(), leaf, y)
    assert_close(evaluated(tape, found, {"x": x, "y": y}), wanted.flatten(), rtol=1e-13, atol=1e-13)


FUNCTIONS = {
    "sums": lambda x: torch.stack([x[0] + x[1] - 3.0 * x[2], -x[0] - (-x[1]), x.sum()]),
    "products": lambda x: torch.stack([x[0] * x[1] * x[2], x[0] / x[1], 2.0 / x[2], x[0] * x[0], x[1] ** 5]),
    "functions": lambda x: torch.stack([x.abs().sqrt(), x.sin(), x.cos(), x.exp(), x.abs().log(), x.tanh()]),
    "choices": lambda x: torch.cat(
        [torch.maximum(x, 0.5 * x[[1, 2, 0]]), x.clamp(-0.5, 0.5), torch.where(x > 0.2, x * x, 3.0 * x)]
    ),
    "angle": lambda x: torch.atan2(x, x[[1, 2, 0]]),
    "chain": lambda x: x.sin() * (x * x).cos() / (1.5 + x.tanh()).sqrt(),
    "one number many times": lambda x: (x[0].sin() * torch.ones(4, dtype=x.dtype) * x[0]) + x[1],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_are_those_of_torch(name):
    for x in ([0.7, -0.4, 1.3], [-1.2, 0.3, 0.9]):
        checked(FUNCTIONS[name], torch.tensor(x, dtype=torch.float64))


def test_of_two_equal_numbers_each_gets_half():
    checked(lambda x: torch.maximum(x[0], x[1])[None], torch.tensor([0.3, 0.3], dtype=torch.float64))
    checked(lambda x: torch.minimum(x[0], x[1])[None], torch.tensor([0.3, 0.3], dtype=torch.float64))


def branches(x: Tensor) -> Tensor:
    """Roots of numbers below zero, in branches that are not taken; one of them counts outside of its branch as well."""
    root, outside = (x[0] - 2.0).sqrt(), x[1] * x[1]
    inner = torch.where(x[1] > 0.0, (x[1] * outside).sqrt(), x[0] * x[0].sqrt())
    return torch.stack([torch.where(x[0] > 2.0, root * x[1], 3.0 * x[0]), torch.where(x[2] > 0.0, inner, outside)])


@pytest.mark.parametrize(
    "x", [[0.5, 0.3, 1.0], [-0.5, 0.3, 1.0], [0.5, -0.3, 1.0], [-0.5, -0.3, -1.0], [2.5, 0.3, 1.0]]
)
def test_a_branch_that_is_not_taken_counts_nothing(x):
    """Where torch in reverse mode finds nan, as forward mode has it."""
    tape, given, y = Tape(), torch.tensor(x, dtype=torch.float64), torch.tensor([0.7, -1.1], dtype=torch.float64)
    numbers = tape.inputs("x", 3)
    (outputs,) = tape.trace(branches, numbers)
    found = pullback(tape, outputs.tolist(), tape.inputs("y", 2).tolist(), numbers.tolist())
    wanted = y @ torch.func.jacfwd(branches)(given)
    assert wanted.isfinite().all()
    assert_close(evaluated(tape, found, {"x": given, "y": y}), wanted, rtol=1e-13, atol=1e-13)


def test_what_does_not_count_is_zero():
    tape = Tape()
    x, y = tape.inputs("x", 3).tolist(), tape.inputs("y", 1).tolist()
    out = tape.call("mul", x[0], x[0])
    found = pullback(tape, [out], y, x)
    assert found[1:] == [tape.zero, tape.zero]
    assert found[0] != tape.zero


def test_an_input_that_is_itself_a_result_gets_its_weight():
    tape = Tape()
    x, y = tape.inputs("x", 2).tolist(), tape.inputs("y", 2).tolist()
    assert pullback(tape, x, y, x) == y


def test_every_operation_has_a_rule():
    assert set(RULES) == {*UNARY, *BINARY, *TERNARY}


def test_an_operation_without_a_rule_is_refused(monkeypatch):
    tape = Tape()
    x, y = tape.inputs("x", 1).tolist(), tape.inputs("y", 1).tolist()
    out = tape.call("sin", x[0])
    monkeypatch.delitem(RULES, "sin")
    with pytest.raises(Untraceable, match="'sin'"):
        pullback(tape, [out], y, x)


def test_a_pullback_costs_a_few_evaluations_however_many_inputs():
    """Of a quadratic form x'Ax of n numbers: the gradient takes less than five times the operations of the form."""
    n, tape = 12, Tape()
    x = tape.inputs("x", n, 1)
    A = torch.from_numpy(np.random.default_rng(0).standard_normal((n, n)))
    (out,) = tape.trace(lambda x: (x * (A @ x)).sum()[None], x)
    before = len(tape.op)
    pullback(tape, out.ravel().tolist(), tape.inputs("y", 1).tolist(), x.ravel().tolist())
    assert len(tape.op) - before < 5 * before
