"""Pairs against torch.func.jvp, jets against differentiation in time: a lost term of a product rule shows here.

Every operation runs on each choice of which arguments carry tangents, with different numbers of lanes.
"""

from __future__ import annotations

import itertools
import threading

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchmbd.math import elementwise, jet, pair
from torchmbd.math.jet import Jet
from torchmbd.math.pair import Pair

TANGENTS, LANES = 2, 3
V, M = (3,), (3, 3)  # component shapes

OPERATIONS = {
    "add": (lambda a, b: a + b, V, V),
    "subtract": (lambda a, b: a - b, V, V),
    "multiply": (lambda a, b: a * b, V, V),
    "negate": (lambda a: -a, V),
    "float on the left": (lambda a: 2.0 - 3.0 * a, V),
    "float on the right": (lambda a: (a + 1.5) * 0.5 - 4.0, V),
    "combine": (lambda a, b: pair.combine(a, -0.7, b), V, V),
    "sin": (lambda a: elementwise.sin(a), V),
    "cos": (lambda a: elementwise.cos(a), V),
    "cross": (pair.cross, V, V),
    "dot": (pair.dot, V, V),
    "matvec": (pair.matvec, M, V),
    "matvec_t": (pair.matvec_t, M, V),
    "matmul": (pair.matmul, M, M),
    "contract two axes": (lambda a, b: pair.contract(a, b, (0, 1)), M, M),
    "cat": (lambda a, b: pair.cat([a, b]), V, M[:1]),
    "cat second axis": (lambda a, b: pair.cat([a, b, a], 1), M, M),
    "constant map": (lambda a: pair.constant_map(torch.arange(6.0, dtype=torch.float64).reshape(2, 3), a), M),
    "linear": (lambda a: pair.linear(lambda y: y[1:], a), V),
    "shapes": (lambda a: a.transpose(0, 1).flatten(0, 1).unsqueeze(0).unflatten(1, (3, 3)).sum(1)[0, 1:], M),
    "gather": (lambda a: a.index_select(0, torch.tensor([2, 0, 2])), V),
}


def test_reverse_mode_of_a_function_of_numbers_takes_its_slopes_from_forward_mode():
    """A branch that is not taken, a root of a negative number, counts nothing; a number for all gets the sum of all."""

    def f(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return torch.where(s > 0.0, s.sqrt() * rate, t * s)

    s, rate, t = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in ([4.0, -2.0], [0.3, 0.5], 0.7))
    result = elementwise.apply_elementwise(f, s, rate, t)
    assert_close(result, torch.tensor([0.6, -1.4], dtype=torch.float64))
    slopes = torch.autograd.grad(result.sum(), (s, rate, t))
    expected = ([0.075, 0.7], [2.0, 0.0], -2.0)
    for one, other in zip(slopes, expected, strict=True):
        assert_close(one, torch.tensor(other, dtype=torch.float64))


def number(shape: tuple[int, ...], lanes: int, make: torch.Generator) -> Pair:
    return Pair(torch.randn(*shape, 1 + TANGENTS, lanes, generator=make, dtype=torch.float64))


def cases():
    for name, (_, *shapes) in OPERATIONS.items():
        for carries in itertools.product((True, False), repeat=len(shapes)):
            for lanes in itertools.product((1, LANES), repeat=len(shapes)):
                yield pytest.param(name, carries, lanes, id=f"{name}-{carries}-{lanes}")


@pytest.mark.parametrize(("name", "carries", "lanes"), list(cases()))
def test_operation_against_jvp(name, carries, lanes):
    f, *shapes = OPERATIONS[name]
    make = torch.Generator().manual_seed(5)
    numbers = [number(shape, n, make) for shape, n in zip(shapes, lanes, strict=True)]
    values = [x.value for x in numbers]
    result = f(*(x if c else x.value for x, c in zip(numbers, carries, strict=True)))
    if not any(carries):
        assert isinstance(result, Tensor)
        assert_close(result, f(*values), rtol=0, atol=0)
        return
    assert isinstance(result, Pair)
    for k in range(TANGENTS):
        moves = [
            x.tangent[..., k : k + 1, :] if c else torch.zeros_like(x.value)
            for x, c in zip(numbers, carries, strict=True)
        ]
        value, slope = torch.func.jvp(f, tuple(values), tuple(moves))
        assert_close(result.value, value, rtol=1e-14, atol=1e-14)
        assert_close(result.tangent[..., k : k + 1, :], slope, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(("name", "carries", "lanes"), list(cases()))
def test_operation_on_pairs_kept_apart(name, carries, lanes):
    """The form for compilation gives the same numbers."""
    if not any(carries):
        return
    f, *shapes = OPERATIONS[name]
    make = torch.Generator().manual_seed(5)
    numbers = [number(shape, n, make) for shape, n in zip(shapes, lanes, strict=True)]
    expected = f(*(x if c else x.value for x, c in zip(numbers, carries, strict=True)))
    with pair.separate_tangents():
        apart = [Pair.of(x.value, x.tangent) for x in numbers]
        result = f(*(x if c else x.value for x, c in zip(apart, carries, strict=True)))
        assert result.shape == expected.shape
        assert_close(result.full, expected.full, rtol=1e-14, atol=1e-14)


def test_pairs_are_kept_apart_in_one_thread_alone():
    x, kinds = torch.ones(3, 1, 1, dtype=torch.float64), []

    def another_thread() -> None:
        kinds.append(type(Pair.of(x, x)))
        with pair.separate_tangents():
            pass

    with pair.separate_tangents():
        thread = threading.Thread(target=another_thread)
        thread.start()
        thread.join()
        assert type(Pair.of(x, x)) is not Pair
    assert kinds == [Pair]
    assert type(Pair.of(x, x)) is Pair


def test_pair_of_a_value_with_fewer_lanes():
    value, tangent = torch.randn(3, 1, 1, dtype=torch.float64), torch.randn(3, 2, 4, dtype=torch.float64)
    both = Pair.of(value, tangent)
    assert_close(both.value, value.expand(3, 1, 4))
    assert_close(both.tangent, tangent)


def test_a_product_leaves_its_factors_alone():
    """The product rule is added in place, to the result only."""
    make = torch.Generator().manual_seed(6)
    a, b = number(V, LANES, make), number(V, LANES, make)
    before = a.full.clone(), b.full.clone()
    _ = a * b, pair.cross(a, b)
    assert_close((a.full, b.full), before, rtol=0, atol=0)


# --- jets -------------------------------------------------------------------------------------------------------------


def curve(seed: int, shape: tuple[int, ...] = V):
    """A cubic curve t -> [component..., 1, lanes]."""
    make = torch.Generator().manual_seed(seed)
    c = torch.randn(4, *shape, 1, LANES, generator=make, dtype=torch.float64)
    return lambda t: c[0] + t * (c[1] + t * (c[2] + t * c[3]))


def in_time(f, t: float = 0.3) -> tuple[Tensor, Tensor, Tensor]:
    """f, f', f'' by forward mode twice."""
    at, one = torch.tensor(t, dtype=torch.float64), torch.ones((), dtype=torch.float64)

    def rate(s):
        return torch.func.jvp(f, (s,), (one,))[1]

    velocity, acceleration = torch.func.jvp(rate, (at,), (one,))
    return f(at), velocity, acceleration


JETS = {
    "minus": lambda a, b: a - b,
    "minus constant": lambda a, b: a - 0.7,
    "product": lambda a, b: a * b,
    "product with a constant": lambda a, b: a * torch.full((3, 1, 1), 2.5, dtype=torch.float64),
    "dot": lambda a, b: jet.dot(a, b),
    "sin": lambda a, b: jet.sin(a),
    "cos": lambda a, b: jet.cos(b),
}


@pytest.mark.parametrize("name", JETS)
def test_jet_against_differentiation_in_time(name):
    f, a, b = JETS[name], curve(1), curve(2)
    expected = in_time(lambda t: f(a(t), b(t)))
    result = f(Jet(*in_time(a)), Jet(*in_time(b)))
    for part, value in zip(result.parts, expected, strict=True):
        assert_close(part, value, rtol=1e-13, atol=1e-13)


def test_jet_of_pairs_carries_design_tangents():
    """Constraints are jets of pairs: the acceleration part of a product must carry tangents of all three parts."""
    make = torch.Generator().manual_seed(8)
    a, b = ([number(V, LANES, make) for _ in range(3)] for _ in range(2))

    def acceleration(*parts):
        return jet.dot(Jet(*parts[:3]), Jet(*parts[3:])).acceleration

    both = (*a, *b)
    result = acceleration(*both)
    for k in range(TANGENTS):
        moves = tuple(x.tangent[..., k : k + 1, :] for x in both)
        _, slope = torch.func.jvp(acceleration, tuple(x.value for x in both), moves)
        assert_close(result.tangent[..., k : k + 1, :], slope, rtol=1e-13, atol=1e-13)
