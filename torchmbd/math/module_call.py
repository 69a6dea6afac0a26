"""A module called with other values of its parameters.

torch.func.functional_call restores a parameter once for each of its names: where one module has two, as a laminate that two
bodies share, it leaves the new value behind (torch 2.13). Here every parameter of every module is replaced once, also
where several modules hold the same one.

The parameters are replaced in place, and torch.func keeps what it differentiates in globals of the process: what does either is
`exclusive`, one thread at a time. Its operators of torch run in one thread, too: two make it 2 to 50 times slower.

Under a transform of torch.func every tensor that is made is wrapped, also those that are not differentiated: what makes tensors
that stay, or reads their memory, is run by `outside_transforms`.
Checked in tests/math/test_module_call.py.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from torchmbd.process import one_thread

P = ParamSpec("P")
R = TypeVar("R")
_LOCK = threading.RLock()


def exclusive(f: Callable[P, R]) -> Callable[P, R]:
    """A function that one thread runs at a time, with one thread of torch; others wait."""

    @functools.wraps(f)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with _LOCK, one_thread():
            return f(*args, **kwargs)

    return alone


@exclusive
def call_module(module: nn.Module, values: Mapping[str, Tensor], *args: Any) -> Any:
    """module(*args) with the named parameters at other values; differentiable by these."""
    places: dict[tuple[int, str], str] = {}
    own: dict[str, Tensor] = {}
    for name, x in module.named_parameters(remove_duplicate=False):
        owner, _, last = name.rpartition(".")
        own[places.setdefault((id(module.get_submodule(owner)), last), name)] = x
    names: dict[int, list[str]] = {}
    for name in places.values():
        names.setdefault(id(own[name]), []).append(name)
    given = {place: x for name, x in values.items() for place in names[id(own[name])]}
    return torch.func.functional_call(module, given, args, tie_weights=False)


class _Holder(nn.Module):
    """Runs a function while its module is called with other values."""

    def __init__(self, module: nn.Module):
        super().__init__()
        self.module = module

    def forward(self, run: Callable[[], Any]) -> Any:
        return run()


def run_with_parameters(module: nn.Module, values: Mapping[str, Tensor], run: Callable[[], R]) -> R:
    """run(), in which the module has other values of its named parameters."""
    return call_module(_Holder(module), {f"module.{name}": x for name, x in values.items()}, run)


class _Outside(torch.autograd.Function):
    """An operation whose forward pass runs a function: torch.func lowers it through all transforms first."""

    @staticmethod
    def forward(run: Callable[[], None], x: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        run()
        return x.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        return None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, run: Callable[[], None], x: Tensor) -> tuple[Any, None]:
        return _Outside.apply(run, x), None


def outside_transforms(f: Callable[[], R]) -> R:
    """f() outside of all transforms of torch.func, without gradients."""
    found: list[R] = []
    _Outside.apply(lambda: found.append(f()), torch.zeros(()))
    return found[0]
