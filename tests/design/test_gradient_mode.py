"""The mode of gradients by its estimated cost: few numbers go backwards, also by fewer variables, where steps are compiled."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from torchmbd.design.gradient_mode import cheaper_mode
from torchmbd.integrate.backend import BACKENDS, Backend, likely_backend

COMPILED = pytest.param("native", marks=pytest.mark.skipif("native" not in BACKENDS, reason="no native code"))


@pytest.mark.parametrize("variables", [1, 3, 30])
@pytest.mark.skipif("native" not in BACKENDS, reason="no native code")
def test_few_numbers_are_cheaper_backwards_where_steps_are_compiled(variables):
    """Forward mode costs two simulations before the first variable."""
    assert [cheaper_mode(variables, numbers, BACKENDS["native"]) for numbers in (1, 2, 4)] == ["reverse"] * 3


def test_operators_of_torch_are_cheaper_forwards():
    """Tangents go along with the values; back through the steps all calls are made again."""
    assert [cheaper_mode(3, numbers, Backend) for numbers in (1, 4, 20)] == ["forward"] * 3
    assert cheaper_mode(300, 1, Backend) == "reverse"


@pytest.mark.parametrize("name", ["eager", COMPILED])
def test_many_numbers_are_cheaper_forwards(name):
    assert cheaper_mode(3, 100, BACKENDS[name]) == "forward"
    assert cheaper_mode(30_000, 100, BACKENDS[name]) == "reverse"


@pytest.mark.parametrize("name", ["eager", COMPILED])
def test_more_variables_never_turn_to_forward_and_more_numbers_never_to_reverse(name):
    modes = [[cheaper_mode(n, k, BACKENDS[name]) == "reverse" for n in range(1, 200)] for k in range(1, 200)]
    assert all(sorted(row) == row for row in modes)
    assert all(sorted(column, reverse=True) == list(column) for column in zip(*modes, strict=True))


def test_a_problem_asks_the_backend_that_makes_its_steps():
    arguments = mbd.examples.arm(), 0.01, mbd.Integral(mbd.StrainEnergy("arm"))
    for backend in ("auto", *BACKENDS):
        problem = mbd.Problem(*arguments, steps=4, backend=backend)
        assert problem.gradients == cheaper_mode(2, 1, likely_backend(backend))
