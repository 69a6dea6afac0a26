"""Straight-line code: the same numbers as torch, nothing left of constants."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from torchmbd.extensions.native.codegen.scalars import BINARY, UNARY, Tape, Untraceable
from torchmbd.math import rotation


def evaluated(tape: Tape, nodes: np.ndarray, inputs: dict[str, Tensor]) -> np.ndarray:
    """Numbers of a tape, one operation after another."""
    flat = {name: x.flatten().tolist() for name, x in inputs.items()}
    values: list[float] = []
    for op, args in zip(tape.op, tape.args, strict=True):
        if op == "constant":
            values.append(args[0])
        elif op == "input":
            values.append(flat[args[0]][args[1]])
        else:
            f = UNARY.get(op) or BINARY[op]
            values.append(f(*(values[a] for a in args)))
    return np.array([values[i] for i in nodes.ravel()]).reshape(nodes.shape)


def mixture(x: Tensor, y: Tensor) -> Tensor:
    """Operators of all sorts: x [4, 1, 1], y [3, 4, 1, 1]."""
    table = torch.tensor([2, 0, 0, 1])
    a = (y * x[None]).sum(1) + y.index_select(1, table)[:, 1]
    b = torch.linalg.cross(a, y[:, 3], dim=0).flatten(0, 1)
    c = torch.cat([b, torch.zeros_like(b[:1]), 1.0 / (2.0 + torch.square(a[0])), torch.atan2(a[1], a[2])])
    d = torch.nn.functional.pad(c.permute(1, 0), (1, 2)).transpose(0, 1)
    e = torch.clamp(d, -0.5, 0.5) - 3.0 * torch.clamp_min(d, 0.1) + (d > 0.2).to(d.dtype) * torch.sqrt(d * d + 1.0)
    return torch.stack([e, -e.expand(1, *e.shape)[0]]).unflatten(1, (3, -1)) @ torch.eye(1, dtype=x.dtype)


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return 2.0 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1.0


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, 2])
def test_written_out_operators_compute_the_same(seed: int) -> None:
    tape = Tape()
    x, y = tape.inputs("x", 4, 1, 1), tape.inputs("y", 3, 4, 1, 1)
    (nodes,) = tape.trace(mixture, x, y)
    values = {"x": numbers(4, 1, 1, seed=seed), "y": numbers(3, 4, 1, 1, seed=seed + 1)}
    expected = mixture(**values).numpy()
    np.testing.assert_allclose(evaluated(tape, nodes, values), expected, rtol=1e-13, atol=1e-14)


def test_constants_leave_no_operations() -> None:
    tape = Tape()
    x = tape.inputs("x", 3, 1, 1)
    eye = torch.eye(3, dtype=torch.float64)

    def f(x: Tensor) -> Tensor:
        y = (eye[:, :, None, None] * x).sum(1) + 0.0 * x  # x again
        return torch.cat([y, torch.neg(-y), (y - y), y * 1.0, y - (-1.0) * y * 0.0])

    before = len(tape.op)
    (nodes,) = tape.trace(f, x)
    assert nodes.ravel().tolist() == [*x.ravel(), *x.ravel(), *[tape.zero] * 3, *x.ravel(), *x.ravel()]
    assert [op for op in tape.op[before:] if op not in ("constant", "neg")] == []


def test_what_occurs_twice_is_computed_once() -> None:
    tape = Tape()
    p = tape.inputs("p", 4, 1, 1, 1)
    tape.trace(rotation.rotation_matrix, p)
    count = len(tape.op)
    tape.trace(rotation.rotation_matrix, p)
    assert len(tape.op) == count


def test_an_operator_that_is_not_known_is_named() -> None:
    tape = Tape()
    with pytest.raises(Untraceable, match="argmax"):
        tape.trace(lambda x: x.argmax(0), tape.inputs("x", 3))


def test_a_division_by_a_constant_zero_is_left_to_the_machine() -> None:
    tape = Tape()
    (nodes,) = tape.trace(lambda x: x / torch.zeros_like(x), tape.inputs("x", 2))
    assert [tape.op[i] for i in nodes] == ["div", "div"]
