"""Derivatives of arguments: whether a tensor is being differentiated, and errors where its gradient would be lost.

    refuse_gradients(("rod", "mass"), mass)                InputError for numbers that are read as constants
    @constant_arguments                                    the same for all arguments of a function that are floats
    refuse_lost_gradients(("spring", "law"), f, allowed)   InputError if what a user's function returns depends on other tensors
    is_differentiated(x), untransformed(x)                 tensors under autograd, dual numbers and torch.func

`refuse_lost_gradients` looks at the autograd graph of a result, so the function is called once on plain numbers, and it does
not matter where the function keeps a tensor (closure, global, attribute, partial). A function that takes the number of a
tensor, by `k.detach()`, `k.item()` or `float(k)`, treats it as a constant; torch warns of the last one.
Checked in tests/math/test_gradients.py, tests/sensitivity/test_refused_gradients.py.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ParamSpec, TypeVar

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn
from torch.func import debug_unwrap

from torchmbd.errors import InputError, Path
from torchmbd.math.units import in_si

P = ParamSpec("P")
R = TypeVar("R")
_FLOATS = (float, "float", "float | Tensor")
_VARIABLE_KINDS = {
    "float | Tensor": "a number, or mbd.variable(...) of one",
    "float | Tensor | None": "a number, mbd.variable(...) of one, or None",
    "Varying": "numbers, or a torch.nn.Parameter such as mbd.variable(...)",
    "Angles": "numbers, or a torch.nn.Parameter",
}
_PARAMETER_KINDS = ("Varying", "Angles")  # of which a Parameter may have any shape
_OF_CONSTANTS = "x.detach() in place of the tensor x, which makes a constant of it"
_OF_COMPUTED = (
    "p = torch.nn.Parameter(x.detach()) in place of the tensor x. After the backward pass of the model, x.backward(p.grad) "
    "gives the gradients of the numbers from which x was computed"
)
_CONTAINERS = (list, tuple, set, frozenset)


def is_variable(x: Any) -> bool:
    """True if x is a design variable of one number: a finite float64 Parameter []."""
    return isinstance(x, nn.Parameter) and x.dim() == 0 and x.dtype == torch.float64 and bool(torch.isfinite(x))


def carries_gradient(x: Any) -> bool:
    """True if x is a tensor that requires a gradient or has a tangent, in any mode."""
    return isinstance(x, Tensor) and (x.requires_grad or forward_ad.unpack_dual(x).tangent is not None)


def in_transform(x: Tensor) -> bool:
    """True if x is wrapped by a transform of torch.func (vmap, grad, jvp)."""
    return debug_unwrap(x, recurse=False) is not x


def refuse_batched_by_grad(cotangents: Iterable[Tensor | None]) -> None:
    """InputError for cotangents that `is_grads_batched` made: without storage, and by no transform of torch.func."""
    for x in cotangents:
        if x is None or in_transform(x):
            continue
        try:
            x.untyped_storage()
        except NotImplementedError as error:  # "Cannot access storage of BatchedTensorImpl"
            raise InputError(
                "is_grads_batched",
                True,
                noun="torch.autograd.grad of a motion",
                state="has is_grads_batched=True, for which torch ignores the rules of its operations",
                hint="torch.vmap over torch.autograd.grad, or torch.func.jacrev",
            ) from error


def wraps(*tensors: Tensor) -> bool:
    """True if transforms of torch.func wrap what is computed now of these tensors."""
    return any(map(in_transform, (*tensors, torch.zeros((), dtype=torch.float64))))


def is_differentiated(x: Tensor) -> bool:
    """True if operations on x are differentiated now: by autograd in grad mode, dual numbers or torch.func."""
    return in_transform(x) or (carries_gradient(x) and (torch.is_grad_enabled() or not x.requires_grad))


def untransformed(x: Tensor) -> Tensor:
    """The numbers of x without transforms of torch.func; vmap adds an axis."""
    return debug_unwrap(x).detach()


def all_true(x: Tensor) -> bool:
    """True if all entries are true, also of all members of a batch under torch.func.vmap."""
    return bool(untransformed(x).all())


def refuse_gradients(name: str | Path, value: Any, allowed: str = "numbers", *, parameter: bool = False) -> None:
    """InputError if a number, or one of a list or mapping of numbers, is being differentiated.

    parameter  True: the argument can be one torch.nn.Parameter, which is checked elsewhere; the remedy names it
    """
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, _CONTAINERS):
        if parameter and any(isinstance(x, nn.Parameter) for x in value):
            numbers = ", ".join(
                f"{float(x.detach() if isinstance(x, Tensor) else x):g}" if _number(x) else "..." for x in value
            )
            raise InputError(
                name,
                value,
                "one parameter that holds all of them",
                f"torch.nn.Parameter(torch.tensor([{numbers}], dtype=torch.float64))",
                state="is a list that contains parameters",
            )
        for x in value:
            refuse_gradients(name, x, allowed, parameter=parameter)
    elif carries_gradient(value):
        state = "has a gradient, which the model would lose"
        raise InputError(name, value, allowed, _OF_COMPUTED if parameter else _OF_CONSTANTS, state=state)


def double_precision(name: str | Path, x: nn.Parameter) -> None:
    """InputError unless a parameter has the type of torchmbd's numbers, float64."""
    if x.dtype != torch.float64:
        hint = "dtype=torch.float64 for the tensor of the Parameter"
        raise InputError(name, allowed="torch.float64", hint=hint, state=f"is a Parameter of {x.dtype}")


def refuse_derivatives(name: str | Path, x: Tensor, instead: str) -> None:
    """InputError if x is being differentiated (autograd, dual numbers, torch.func) and that would be lost."""
    if is_differentiated(x):
        raise InputError(
            name,
            state="is being differentiated, but the gradient would be lost here",
            hint=f"x.detach(), and {instead}",
        )


def constant_arguments(f: Callable[P, R]) -> Callable[P, R]:
    """Decorator: InputError names a float argument that is not a number, or an argument whose gradient would be lost.

    An argument annotated `float | Tensor`, also with None, may be a design variable (`is_variable`); one annotated `Varying` or
    `Angles` may be a Parameter of any shape.
    """
    signature = inspect.signature(f)
    floats = {name for name, p in signature.parameters.items() if p.annotation in _FLOATS}
    kinds = {name: str(p.annotation).partition(" | Mapping")[0] for name, p in signature.parameters.items()}

    @functools.wraps(f)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        if any(isinstance(x, (Tensor, Mapping, *_CONTAINERS)) for x in (*args, *kwargs.values())):
            for name, x in signature.bind(*args, **kwargs).arguments.items():
                allowed, parameter = _VARIABLE_KINDS.get(kinds[name]), kinds[name] in _PARAMETER_KINDS
                path = (f.__qualname__.removesuffix(".__init__"), name)
                if parameter and isinstance(x, nn.Parameter):
                    double_precision(path, x)
                elif allowed is None or not is_variable(x):
                    refuse_gradients(path, x, allowed or "numbers", parameter=parameter)
        values = signature.bind_partial(*args, **kwargs).arguments
        for name in floats.intersection(values):
            if not _number(values[name]):
                owner = f.__qualname__.removesuffix(".__init__")
                raise InputError((owner, name), values[name], "a number", in_si(values[name]))
        return f(*args, **kwargs)

    return checked


def _number(x: Any) -> bool:
    """True if x is one real number, also of NumPy or torch."""
    if isinstance(x, (str, bytes, bool)):
        return False
    try:
        float(x.detach() if isinstance(x, Tensor) else x)
    except (TypeError, ValueError, RuntimeError):
        return False
    return True


def refuse_lost_gradients(name: str | Path, result: Any, allowed: str, known: Iterable[Tensor] = ()) -> None:
    """InputError if the result of a user's function depends on another tensor, whose gradient would be lost.

    result   of a call in grad mode
    known    tensors that are differentiated: arguments of the function, registered parameters
    """
    if not isinstance(result, Tensor):
        return
    held = _held(result, list(known))
    if held is not None:
        shown = " ".join(repr(held).split())
        raise InputError(
            name,
            allowed=f"{allowed}, such as x.detach() if x does not vary",
            state=f"reads a tensor that requires a gradient, but torchmbd does not know this tensor: {shown}",
        )


def _held(result: Tensor, known: list[Tensor]) -> Tensor | None:
    """A leaf of the autograd graph of a result that is not one of the known tensors and not behind one; None without one."""
    ends: list[Any] = [x.grad_fn for x in known if x.grad_fn is not None]  # alive: nodes are compared by identity
    leaves, seen = {id(x) for x in known}, {id(node) for node in ends}
    if result.requires_grad and result.is_leaf:
        return None if id(result) in leaves else result
    stack: list[Any] = [result.grad_fn]
    while stack:
        node = stack.pop()
        if node is None or id(node) in seen:
            continue
        seen.add(id(node))
        ends.append(node)
        leaf = getattr(node, "variable", None)
        if leaf is not None and id(leaf) not in leaves:
            return leaf
        stack += [parent for parent, _ in node.next_functions]
    return None
