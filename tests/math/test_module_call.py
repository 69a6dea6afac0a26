"""A module with other values of its parameters: shared modules, shared parameters, nothing left behind."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from torchmbd.math.module_call import call_module, exclusive


class Power(nn.Module):
    def __init__(self, x: nn.Parameter):
        super().__init__()
        self.x = x


class Product(nn.Module):
    """2 first.x * second.x."""

    def __init__(self, first: Power, second: Power):
        super().__init__()
        self.first, self.second = first, second

    def forward(self, factor: float) -> Tensor:
        return factor * self.first.x * self.second.x


def products() -> list[tuple[Product, nn.Parameter]]:
    x = nn.Parameter(torch.tensor(3.0))
    one = Power(x)
    return [(Product(one, one), x), (Product(Power(x), Power(x)), x)]


def test_a_parameter_changes_wherever_it_is_held():
    for module, x in products():
        new = torch.tensor(5.0)
        result = torch.func.jvp(lambda y, m=module: call_module(m, {"first.x": y}, 2.0), (new,), (torch.ones(()),))
        assert [float(x) for x in result] == [50.0, 20.0]
        assert module.first.x is x
        assert module.second.x is x
        assert float(call_module(module, {}, 2.0)) == 18.0


def test_parameters_that_are_apart_stay_apart():
    module = Product(Power(nn.Parameter(torch.tensor(3.0))), Power(nn.Parameter(torch.tensor(4.0))))
    assert float(call_module(module, {"first.x": torch.tensor(5.0)}, 1.0)) == 20.0


@pytest.fixture
def two_threads(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_what_is_exclusive_has_one_thread_of_torch_and_restores_their_number():
    @exclusive
    def threads(error: Exception | None = None) -> int:
        if error:
            raise error
        return torch.get_num_threads()

    assert threads() == 1
    with pytest.raises(ArithmeticError):
        threads(ArithmeticError())
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_a_number_of_threads_in_the_environment_holds(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert exclusive(torch.get_num_threads)() == 2
