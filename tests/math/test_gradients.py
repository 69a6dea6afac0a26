"""The walk through what a law holds: where it ends, and what it finds; the rest is in tests/sensitivity."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from tests.refused import refused
from torchmbd.math.gradients import carries_gradient, constant_arguments, refuse_gradients, refuse_lost_gradients

K = nn.Parameter(torch.ones((), dtype=torch.float64))


def test_the_walk_ends_where_things_hold_each_other():
    held: list[Any] = [K.detach()]
    held.append(held)
    refuse_lost_gradients("law of 'x'", held, "none")
    held.append({"k": K})
    with refused("law of 'x'"):
        refuse_lost_gradients("law of 'x'", held, "none")

    @constant_arguments
    def f(x: Any, y: Any = None) -> Any:
        return y

    assert f(1, y=K.detach()) is not None
    with refused("test_the_walk_ends_where_things_hold_each_other.<locals>.f.y"):
        f(1, {"a": [K]})


def test_what_torch_func_differentiates_is_seen_and_constants_made_inside_are_not():
    def f(x: torch.Tensor) -> torch.Tensor:
        one = torch.ones(2, dtype=torch.float64)
        assert (carries_gradient(x), carries_gradient(2.0 * x), carries_gradient(one)) == (True, True, False)
        refuse_gradients("one", [one])
        with refused("x"):
            refuse_gradients("x", {"a": (x,)})
        return x.sum()

    x = torch.ones(2, dtype=torch.float64)
    for transform in (torch.func.grad, torch.func.jacfwd, torch.func.jacrev):
        transform(f)(x)
    torch.func.jvp(f, (x,), (x,))


class Parts:
    """Numbers whose names are those of globals."""

    K = 2.0


def test_an_attribute_with_the_name_of_a_global_is_no_global():
    parts = Parts()
    refuse_lost_gradients("law of 'x'", lambda s: parts.K * s, "none")


def test_a_global_that_only_an_inner_function_reads_is_seen():
    def law(s: Any) -> Any:
        return (lambda x: -float(K) * x)(s)

    with refused("law of 'x'"):
        refuse_lost_gradients("law of 'x'", law, "none")
