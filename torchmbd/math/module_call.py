"""Calls of torch modules with other values of their parameters, and functions that run outside of torch.func.

torch.func.functional_call restores a parameter once for each of its names: where one module has two names, as a laminate that
two bodies share, the new value remains (torch 2.13). `call_module` replaces every parameter of every module once.

Parameters are replaced in place, and torch.func keeps its transforms in globals of the process: functions that use either are
`exclusive`, run by one thread at a time. Their operators of torch use one thread, too: two make them 2 to 50 times slower.

Under a transform of torch.func every new tensor is wrapped, also one that is not differentiated: code that keeps tensors, or
reads their memory, is run by `outside_transforms`. What is computed once and kept is none of the tensors that the calling graph
saves: torch.utils.checkpoint counts those, and its second pass does not compute it again.
Checked in tests/math/test_module_call.py.
"""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from torchmbd.math.vmap import as_lanes
from torchmbd.process import keep_freed_memory, one_thread

P = ParamSpec("P")
R = TypeVar("R")
_LOCK = threading.RLock()


@contextmanager
def alone() -> Iterator[None]:
    """Keep other threads out of exclusive functions, and operators of torch in one thread."""
    keep_freed_memory()
    with _LOCK, one_thread():
        yield


def exclusive(f: Callable[P, R]) -> Callable[P, R]:
    """Decorator: one thread at a time runs any of the exclusive functions, with one thread of torch; others wait.

    torch.compile does not trace them; it compiles what is around them.
    """

    def run_alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with alone():
            return f(*args, **kwargs)

    @functools.wraps(f)
    def locked(*args: P.args, **kwargs: P.kwargs) -> R:
        # The compiler of torch takes seconds to import: where it is not loaded, nothing is traced.
        run = torch.compiler.disable(run_alone) if "torch._dynamo" in sys.modules else run_alone
        return run(*args, **kwargs)  # pyright: ignore[reportCallIssue]

    locked._torchdynamo_disable = True  # pyright: ignore[reportAttributeAccessIssue]
    return locked


@exclusive
def call_module(module: nn.Module, values: Mapping[str, Tensor], *args: Any) -> Any:
    """Return module(*args) with other values of the named parameters; differentiable with respect to these."""
    first_names: dict[tuple[int, str], str] = {}  # submodule and attribute -> first name of the parameter
    parameters: dict[str, Tensor] = {}
    for name, x in module.named_parameters(remove_duplicate=False):
        owner, _, last = name.rpartition(".")
        parameters[first_names.setdefault((id(module.get_submodule(owner)), last), name)] = x
    names: dict[int, list[str]] = {}  # parameter -> its names in different submodules
    for name in first_names.values():
        names.setdefault(id(parameters[name]), []).append(name)
    replacements = {other: x for name, x in values.items() for other in names[id(parameters[name])]}
    return torch.func.functional_call(module, replacements, args, tie_weights=False)


class _Runner(nn.Module):
    """Runs a function as its forward pass, while parameters of `module` are replaced."""

    def __init__(self, module: nn.Module):
        super().__init__()
        self.module = module

    def forward(self, run: Callable[[], Any]) -> Any:
        return run()


def run_with_parameters(module: nn.Module, values: Mapping[str, Tensor], run: Callable[[], R]) -> R:
    """Return run() while the named parameters of the module have other values."""
    return call_module(_Runner(module), {f"module.{name}": x for name, x in values.items()}, run)


def _itself(x: Tensor) -> Tensor:
    return x


def _separate_hooks() -> ExitStack:
    """Context in which saved tensors are none of those that hooks of the caller see."""
    stack = ExitStack()
    try:
        stack.enter_context(torch.autograd.graph.saved_tensors_hooks(_itself, _itself))
    except RuntimeError:  # a transform of torch.func allows no hooks: then the caller has none
        stack.close()
    return stack


class _Outside(torch.autograd.Function):
    """An operation whose forward pass runs a function; torch.func calls it after removing all of its transforms."""

    @staticmethod
    def forward(run: Callable[..., None], x: Tensor, *tensors: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        with _separate_hooks():
            run(*tensors)
        return x.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        return None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, run: Callable[..., None], x: Tensor, *tensors: Tensor) -> tuple[Any, None]:
        return _Outside.apply(run, x, *as_lanes(tensors, in_dims[2:], info.batch_size)), None


def outside_transforms(f: Callable[..., R], *tensors: Tensor) -> R:
    """Return f(*tensors) outside of all transforms of torch.func and hooks of saved tensors, without gradients.

    tensors   [..., lanes]; a batch of torch.func.vmap becomes further lanes
    """
    results: list[R] = []
    nothing = torch.zeros((), dtype=torch.float64)
    _Outside.apply(lambda *x: results.append(f(*x)), nothing, *(x.detach() for x in tensors))
    return results[0]
