"""Derivatives of arguments: whether a tensor is being differentiated, and errors where its gradient would be lost.

    refuse_gradients(("rod", "mass"), mass)                InputError for numbers that are read as constants
    @constant_arguments                                    the same for all arguments of a function that are floats
    refuse_lost_gradients(("spring", "law"), law, allowed) InputError for tensors with a gradient that a user's function holds
    is_differentiated(x), untransformed(x)                 tensors under autograd, dual numbers and torch.func

`refuse_lost_gradients` searches closures, default arguments, globals, bound objects, attributes, functools.partial and
containers of a function, and the modules and functions that these refer to. Which globals a function reads is in its bytecode
alone: `co_names` has attributes too, and would refuse `p.k` for a global variable k.
Checked in tests/math/test_gradients.py, tests/sensitivity/test_refused_gradients.py.
"""

from __future__ import annotations

import dis
import functools
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ParamSpec, TypeVar

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn
from torch.func import debug_unwrap

from torchmbd.errors import InputError, Path

P = ParamSpec("P")
R = TypeVar("R")
_FLOATS = (float, "float", "float | Tensor")
_VARIABLE_KINDS = {
    "float | Tensor": "a number, or mbd.variable(...) of one",
    "float | Tensor | None": "a number, mbd.variable(...) of one, or None",
    "Varying": "numbers, or a torch.nn.Parameter such as mbd.variable(...)",
    "Angles": "numbers, or a torch.nn.Parameter",
}
_CONTAINERS = (list, tuple, set, frozenset)
_CLOSED = (types.ModuleType, type, str, bytes, int, float, complex, type(None), torch.dtype, torch.device)
_OF_MODULE = frozenset(vars(nn.Module()))
_LIBRARIES = ("torch", "numpy", "scipy", "builtins", "functools", "operator")


def is_variable(x: Any) -> bool:
    """True if x is a design variable of one number: a finite float64 Parameter []."""
    return isinstance(x, nn.Parameter) and x.dim() == 0 and x.dtype == torch.float64 and bool(torch.isfinite(x))


def carries_gradient(x: Any) -> bool:
    """True if x is a tensor that requires a gradient or has a tangent, in any mode."""
    return isinstance(x, Tensor) and (x.requires_grad or forward_ad.unpack_dual(x).tangent is not None)


def in_transform(x: Tensor) -> bool:
    """True if x is wrapped by a transform of torch.func (vmap, grad, jvp)."""
    return debug_unwrap(x, recurse=False) is not x


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


def refuse_gradients(name: str | Path, value: Any, allowed: str = "numbers") -> None:
    """InputError if a number, or one of a list or mapping of numbers, is being differentiated."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, _CONTAINERS):
        for x in value:
            refuse_gradients(name, x, allowed)
    elif carries_gradient(value):
        shown = " ".join(repr(value).split())
        state = f"carries a gradient, which would be lost here: {shown}"
        raise InputError(name, value, f"{allowed}, or x.detach()", state=state)


def refuse_derivatives(name: str | Path, x: Tensor, instead: str) -> None:
    """InputError if x is being differentiated (autograd, dual numbers, torch.func) and that would be lost."""
    if is_differentiated(x):
        raise InputError(
            name, allowed=f"x.detach(), and {instead}", state="is being differentiated, which would be lost here"
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
                allowed = _VARIABLE_KINDS.get(kinds[name])
                parameter = isinstance(x, nn.Parameter) and x.dtype == torch.float64
                if allowed is None or not (is_variable(x) or ("torch.nn" in allowed and parameter)):
                    refuse_gradients((f.__qualname__.removesuffix(".__init__"), name), x, allowed or "numbers")
        values = signature.bind_partial(*args, **kwargs).arguments
        for name in floats.intersection(values):
            if not _number(values[name]):
                owner = f.__qualname__.removesuffix(".__init__")
                raise InputError((owner, name), values[name], "a number")
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


def refuse_lost_gradients(name: str | Path, law: Any, allowed: str, registered: nn.Module | None = None) -> None:
    """InputError if a function or object of a user contains a tensor whose gradient would be lost.

    registered   a module whose parameters are differentiated, and so allowed
    """
    known = {id(x) for x in registered.parameters()} if registered is not None else set()
    seen: set[int] = set()
    stack: list[tuple[str, Any]] = [("", law)]
    while stack:
        path, x = stack.pop()
        if isinstance(x, Tensor):
            if carries_gradient(x) and id(x) not in known:
                raise InputError(
                    name,
                    allowed=f"{allowed}, such as x.detach() if x does not vary",
                    state=f"has design variables ({path.strip() or 'itself'}), which would not be differentiated",
                )
        elif id(x) not in seen and not isinstance(x, _CLOSED):
            seen.add(id(x))
            stack += [(f"{path} {label}", y) for label, y in _contents(x)]


def _contents(x: Any) -> Iterator[tuple[str, Any]]:
    """The contents of an object, with labels."""
    if isinstance(x, Mapping):
        yield from ((f"[{key!r}]", y) for key, y in x.items())
    elif isinstance(x, _CONTAINERS):
        yield from ((f"[{i}]", y) for i, y in enumerate(x))
    elif isinstance(x, functools.partial):
        yield from (("function", x.func), ("arguments", x.args), ("arguments", x.keywords))
    elif isinstance(x, types.MethodType):
        yield from (("method", x.__func__), ("object", x.__self__))
    elif isinstance(x, types.FunctionType):
        yield from _function_contents(x)
    elif isinstance(x, nn.Module):
        for members in (x.named_parameters(recurse=False), x.named_buffers(recurse=False), x.named_children()):
            yield from ((f"module {name}", y) for name, y in members)
        if not _of_library(type(x)):
            yield "method", type(x).forward
            yield from ((f"attribute {k}", y) for k, y in vars(x).items() if k not in _OF_MODULE)
    elif not _of_library(type(x)):
        methods = {k: f for kind in reversed(type(x).__mro__) for k, f in vars(kind).items()}
        yield "method", methods.get("__call__")
        slots = [k for kind in type(x).__mro__ for k in getattr(kind, "__slots__", ()) if isinstance(k, str)]
        attributes = getattr(x, "__dict__", {}) | {k: getattr(x, k) for k in slots if hasattr(x, k)}
        yield from ((f"attribute {name}", y) for name, y in attributes.items())


def _function_contents(f: types.FunctionType) -> Iterator[tuple[str, Any]]:
    for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True):
        try:
            yield f"closure {name}", cell.cell_contents
        except ValueError:  # an empty cell: a function that calls itself
            continue
    yield from (("default", f.__defaults__), ("defaults", f.__kwdefaults__), ("attributes", vars(f)))
    if not _of_library(f):
        yield from ((f"global {name}", f.__globals__[name]) for name in _globals(f.__code__) if name in f.__globals__)


@functools.lru_cache(maxsize=1024)  # laws are looked at before every batch
def _globals(code: types.CodeType) -> set[str]:
    """Names of globals that a function, or one defined in it, reads."""
    names = {x.argval for x in dis.get_instructions(code) if x.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return names.union(*(_globals(c) for c in code.co_consts if isinstance(c, types.CodeType)))


def _of_library(x: Any) -> bool:
    return (getattr(x, "__module__", None) or "builtins").partition(".")[0] in _LIBRARIES
