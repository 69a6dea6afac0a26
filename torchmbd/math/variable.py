"""Numbers of laws, loads and materials that are design variables: parameters of torch modules.

    mbd.Sine(mbd.variable(0.4), frequency=1.5)                an amplitude that is a design variable
    mbd.SpringDamper(a, b, stiffness=mbd.variable(2e3))       a stiffness
    mbd.Ply(E1=mbd.variable(128e9), ...)                      a modulus: a field of a frozen dataclass of numbers (`Numbers`)

A variable that is used several times is one design variable. In the data of a design the variables of a law are one vector
[k, pair, lanes].
Checked in tests/sensitivity/test_law_variables.py.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import is_real, scalar, with_unit
from torchmbd.math.gradients import is_variable
from torchmbd.math.pair import linear
from torchmbd.math.units import in_si


def variable(x: float | Tensor) -> nn.Parameter:
    """A number as a design variable: a parameter [] of the law, load, drive or dimension that it is passed to.

    x  initial value, finite, in the unit of the argument that it is passed as

    >>> arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))
    >>> push = mbd.Force(arm.at(), (mbd.variable(2.0), 0.0, 0.0), name="push")
    >>> system = mbd.System([arm], [mbd.Prismatic(mbd.Ground().at(), arm.at(), axis="x")], [push])
    >>> [(name, number.item()) for name, number in system.named_parameters()]
    [('push.x', 2.0)]
    """
    value = x.detach() if isinstance(x, Tensor) else x
    if (torch.is_tensor(value) and value.numel() > 1) or isinstance(value, (list, tuple)):
        several = value.tolist() if torch.is_tensor(value) else [*value]
        hint = f"torch.nn.Parameter(torch.tensor({several}, dtype=torch.float64)), for several numbers"
        raise InputError("variable", value, "one finite number", hint, shown=f"{several}")
    return nn.Parameter(torch.tensor(scalar("variable", value, "one finite number"), dtype=torch.float64))


def number(x: Any) -> Any:
    """The current value of a variable as a float; any other argument unchanged."""
    return float(x.detach()) if is_variable(x) else x


def varies(numbers: Any) -> bool:
    """True if a field of a frozen dataclass of numbers, or of a dataclass in it, is a variable."""
    values = [getattr(numbers, f.name) for f in fields(numbers)] if is_dataclass(numbers) else []
    return any(is_variable(x) or varies(x) for x in values)


def with_fields(numbers: Any, values: dict[str, Any]) -> Any:
    """A copy of a frozen dataclass with other fields, without its checks: fields of a batch of designs have lanes."""
    result = copy.copy(numbers)
    for name, x in values.items():
        object.__setattr__(result, name, x)
    return result


def without_variables(numbers: Any) -> Any:
    """A frozen dataclass of numbers with the current values of its variables; any other argument unchanged."""
    if not varies(numbers):
        return numbers
    values = {f.name: getattr(numbers, f.name) for f in fields(numbers)}
    plain = {name: number(x) if is_variable(x) else without_variables(x) for name, x in values.items()}
    return with_fields(numbers, plain)


def check_positive(numbers: Any, unit: str = "", infinite: bool = False) -> None:
    """InputError unless the fields that `numbers.positive` names are positive; finite, unless `infinite` is allowed."""
    for name in numbers.positive:
        value = number(getattr(numbers, name))
        if not (is_real(value) and value > 0.0 and (infinite or math.isfinite(value))):
            allowed = "a number > 0" if infinite else "a finite number > 0"
            allowed = f"{allowed}, or mbd.variable(...) of one"
            noun, shown = f"{type(numbers).__name__}: {name}", with_unit(value, unit)
            raise InputError(name, value, allowed, in_si(value), noun=noun, shown=shown)


def stacked(numbers: Sequence[Any]) -> Tensor:
    """Numbers and tensors [] or [lanes] as one tensor [*lanes, n]."""
    tensors = [x if isinstance(x, Tensor) else torch.tensor(x, dtype=torch.float64) for x in numbers]
    return torch.stack(torch.broadcast_tensors(*tensors), -1)


class Numbers(nn.Module):
    """A frozen dataclass of numbers, some of which are variables: a parameter for each variable, with the name of its field.

    numbers()     the dataclass with the values of the current design, variables [] or [lanes]

    A field that is itself such a dataclass is a submodule, so its variables have names such as "strength.Xt".
    """

    def __init__(self, record: Any):
        super().__init__()
        self.record = record
        # Names of fields that are positive, zero or positive in every design.
        self.positive: tuple[str, ...] = getattr(record, "positive", ())
        self.nonnegative: tuple[str, ...] = getattr(record, "nonnegative", ())
        for f in fields(record):
            x = getattr(record, f.name)
            if is_variable(x):
                self.register_parameter(f.name, x)
            elif varies(x):
                self.add_module(f.name, Numbers(x))

    def forward(self) -> Any:
        nested = {name: x() for name, x in self._modules.items() if x is not None}
        return with_fields(self.record, self._parameters | nested)


class LayerNumbers:
    """Dataclasses of numbers, one for each layer; those with variables are submodules of `owner`.

    The name of a submodule is `label`, or `label` and the index of its first layer ("ply2") if layers have different ones.
    """

    def __init__(self, owner: nn.Module, label: str, layers: Sequence[Any]):
        first: dict[int, int] = {}
        for k, x in enumerate(layers):
            first.setdefault(id(x), k)
        names = {i: label if len(first) == 1 else f"{label}{k}" for i, k in first.items() if varies(layers[k])}
        self.layers = tuple(layers)
        self.names = tuple(names.get(id(x)) for x in layers)  # of the submodules, None without variables
        for name, x in {name: x for name, x in zip(self.names, layers, strict=True) if name is not None}.items():
            owner.add_module(name, Numbers(x))

    @property
    def vary(self) -> bool:
        """True if a layer has variables."""
        return any(self.names)

    def current(self, owner: nn.Module) -> tuple[Any, ...]:
        """The dataclasses of all layers with the values of the current design."""
        values = {name: owner.get_submodule(name)() for name in self.names if name is not None}
        return tuple(x if name is None else values[name] for x, name in zip(self.layers, self.names, strict=True))


def law_key(name: str) -> str:
    """Key, among the data of a design, of the variables in the law of a joint or force."""
    return f"law {name}"


class ParameterVector:
    """The parameters of a module as one vector of numbers."""

    def __init__(self, module: nn.Module):
        self.module = module
        self.shapes = {name: x.shape for name, x in module.named_parameters()}

    @classmethod
    def of(cls, x: Any) -> ParameterVector | None:
        """The vector of a module; None for a module without parameters, or another object."""
        return cls(x) if isinstance(x, nn.Module) and any(True for _ in x.parameters()) else None

    def flat(self) -> Tensor:
        """Current values [k, 1, lanes]; each parameter may have a leading axis of lanes."""
        parts = []
        for name, x in self.module.named_parameters():
            lanes = x.shape[0] if x.dim() > len(self.shapes[name]) else 1
            parts.append(x.reshape(lanes, -1))
        lanes = max(x.shape[0] for x in parts)
        return torch.cat([x.expand(lanes, -1) for x in parts], 1).T[:, None]

    def named(self, flat: Any) -> dict[str, Any]:
        """Parameters by name, of shape [*shape, ...], from the vector [k, ...]."""
        parameters, start = {}, 0
        for name, shape in self.shapes.items():
            part = flat[start : start + shape.numel()]
            parameters[name] = linear(lambda x, shape=shape: x.reshape((*shape, *x.shape[1:])), part)
            start += shape.numel()
        return parameters

    def evaluated(self) -> Any:
        """The tensors that the module returns, [lanes, ...] for a batch of designs."""

        def of_design(x: Tensor) -> Any:
            return torch.func.functional_call(self.module, self.named(x), ())

        has_lanes = any(x.dim() > len(self.shapes[name]) for name, x in self.module.named_parameters())
        result = torch.func.vmap(of_design, 1)(self.flat()[:, 0])
        if has_lanes:
            return result
        return tuple(x[0] for x in result) if isinstance(result, tuple) else result[0]
