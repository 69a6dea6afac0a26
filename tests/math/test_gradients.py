"""Arguments that are constants, and what the result of a user's function depends on; the rest is in tests/sensitivity."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.math.gradients import carries_gradient, constant_arguments, refuse_gradients, refuse_lost_gradients

K = nn.Parameter(torch.ones((), dtype=torch.float64))


def test_an_argument_of_numbers_names_the_parameter_that_it_contains():
    @constant_arguments
    def f(x: Any, y: Any = None) -> Any:
        return y

    assert f(1, y=K.detach()) is not None
    with refused("test_an_argument_of_numbers_names_the_parameter_that_it_contains.<locals>.f.y"):
        f(1, {"a": [K]})


def test_a_list_of_variables_has_one_parameter_as_its_remedy():
    walls = [mbd.variable(1e-3), 2e-3]
    remedy = "torch.nn.Parameter(torch.tensor([0.001, 0.002], dtype=torch.float64))"
    with refused("tube.thickness", walls, remedy):
        mbd.sections.tube(0.02, mbd.examples.carbon(), mbd.deg([0, 90]), thickness=walls)


def test_a_computed_tensor_has_a_parameter_as_its_remedy_and_single_precision_the_type():
    ply, x = mbd.examples.carbon(), torch.zeros(2, dtype=torch.float64, requires_grad=True)
    with refused("angles", ANY, "torch.nn.Parameter(x.detach())", "x.backward(p.grad)"):
        mbd.Laminate(ply, 2.0 * x, 1e-3)
    with refused("angles", ANY, "torch.float32", "dtype=torch.float64"):
        mbd.Laminate(ply, torch.nn.Parameter(torch.zeros(2)), 1e-3)


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


def test_a_result_of_plain_numbers_is_taken():
    parts, s = Parts(), torch.ones(2, dtype=torch.float64)
    for result in (parts.K * s, K.detach() * s, K.item() * s, 1.0, None):
        refuse_lost_gradients("law of 'x'", result, "none")


@pytest.mark.parametrize("kind", ["leaf", "computed", "in a list of others"])
def test_a_result_that_depends_on_a_tensor_that_is_not_known_is_refused(kind):
    k, s = (2.0 * K).exp(), torch.ones((), dtype=torch.float64)
    result = {"leaf": K, "computed": k * s, "in a list of others": torch.stack([s, k]).sum()}[kind]
    with refused("law of 'x'"):
        refuse_lost_gradients("law of 'x'", result, "none")
    refuse_lost_gradients("law of 'x'", result, "none", known=[K])
    if kind != "leaf":
        refuse_lost_gradients("law of 'x'", result, "none", known=[k])


def test_a_tensor_beside_a_known_one_is_seen():
    known = K.detach().clone().requires_grad_()
    with refused("law of 'x'"):
        refuse_lost_gradients("law of 'x'", 2.0 * known + K, "none", known=[known])
