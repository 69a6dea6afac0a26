"""Numbers of laws that vary with the design: parameters of torch modules.

    mbd.Sine(mbd.variable(0.4), frequency=1.5)                an amplitude that is a design variable
    mbd.SpringDamper(a, b, stiffness=mbd.variable(2e3))       a stiffness
    mbd.Ply(E1=mbd.variable(128e9), ...)                      a modulus: a field of a frozen dataclass of numbers (`Numbers`)

The same variable in several places is one design variable. Among the data of a design they are flat [k, pair, lanes].
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
from torchmbd.math.checked_numbers import is_real, scalar
from torchmbd.math.gradients import is_variable
from torchmbd.math.pair import linear


def variable(x: float | Tensor) -> nn.Parameter:
    """A number as a design variable: a parameter [] of the law, load, drive or dimension in which it stands.

    x  its first value, finite, in the unit of its place

    >>> arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))
    >>> push = mbd.Force(arm.at(), (mbd.variable(2.0), 0.0, 0.0), name="push")
    >>> system = mbd.System([arm], [mbd.Prismatic(mbd.Ground().at(), arm.at(), axis="x")], [push])
    >>> [(name, number.item()) for name, number in system.named_parameters()]
    [('push.x', 2.0)]
    """
    given = x.detach() if isinstance(x, Tensor) else x
    return nn.Parameter(torch.tensor(scalar("variable", given, "one finite number"), dtype=torch.float64))


def number(x: Any) -> Any:
    """The present number of a variable; anything else as it is."""
    return float(x.detach()) if is_variable(x) else x


def varies(given: Any) -> bool:
    """Whether a field of a frozen dataclass of numbers, or of one within it, is a variable."""
    own = [getattr(given, f.name) for f in fields(given)] if is_dataclass(given) else []
    return any(is_variable(x) or varies(x) for x in own)


def with_fields(given: Any, values: dict[str, Any]) -> Any:
    """A frozen dataclass with other fields, unchecked: a design has its lanes in them."""
    result = copy.copy(given)
    for name, x in values.items():
        object.__setattr__(result, name, x)
    return result


def without_variables(given: Any) -> Any:
    """A frozen dataclass of numbers whose variables are the numbers that they have now; anything else as it is."""
    if not varies(given):
        return given
    own = {f.name: getattr(given, f.name) for f in fields(given)}
    return with_fields(given, {name: number(x) if is_variable(x) else without_variables(x) for name, x in own.items()})


def check_positive(given: Any, unit: str = "", infinite: bool = False) -> None:
    """InputError unless the fields that `given.positive` names are positive; finite, unless `infinite` is allowed."""
    for name in given.positive:
        value = number(getattr(given, name))
        if not (is_real(value) and value > 0.0 and (infinite or math.isfinite(value))):
            allowed = "a number > 0" if infinite else "a finite number > 0"
            raise InputError(
                f"{type(given).__name__}: {name} = {value!r}{unit}; allowed: {allowed}, or mbd.variable(...) of one"
            )


def stacked(numbers: Sequence[Any]) -> Tensor:
    """Numbers [] and [lanes] as one tensor [*lanes, n]."""
    own = [x if isinstance(x, Tensor) else torch.tensor(x, dtype=torch.float64) for x in numbers]
    return torch.stack(torch.broadcast_tensors(*own), -1)


class Numbers(nn.Module):
    """A frozen dataclass of numbers, some of which vary: a parameter for each field that does, by its name.

    numbers()     the dataclass of the present design, its variables [] or [lanes]

    Fields that are such dataclasses are modules of their own: "strength.Xt". `given.positive` names those that are, in every
    design.
    """

    def __init__(self, given: Any):
        super().__init__()
        self.given = given
        self.positive: tuple[str, ...] = getattr(given, "positive", ())
        for f in fields(given):
            x = getattr(given, f.name)
            if is_variable(x):
                self.register_parameter(f.name, x)
            elif varies(x):
                self.add_module(f.name, Numbers(x))

    def forward(self) -> Any:
        return with_fields(
            self.given, self._parameters | {name: x() for name, x in self._modules.items() if x is not None}
        )


class LayerNumbers:
    """Dataclasses of numbers, one for each layer; those that vary are modules of `owner`.

    Their names are the label, or label and first layer ("ply2") where the layers have several.
    """

    def __init__(self, owner: nn.Module, label: str, given: Sequence[Any]):
        first: dict[int, int] = {}
        for k, x in enumerate(given):
            first.setdefault(id(x), k)
        names = {i: label if len(first) == 1 else f"{label}{k}" for i, k in first.items() if varies(given[k])}
        self.given = tuple(given)
        self.names = tuple(names.get(id(x)) for x in given)
        for name, x in {name: x for name, x in zip(self.names, given, strict=True) if name is not None}.items():
            owner.add_module(name, Numbers(x))

    @property
    def vary(self) -> bool:
        """Whether one of them does."""
        return any(self.names)

    def now(self, owner: nn.Module) -> tuple[Any, ...]:
        """Those of the present design."""
        made = {name: owner.get_submodule(name)() for name in self.names if name is not None}
        return tuple(x if name is None else made[name] for x, name in zip(self.given, self.names, strict=True))


def law_key(name: str) -> str:
    """Where the design variables of the law of a joint or force are among the data of a design."""
    return f"law {name}"


class ParameterVector:
    """The parameters of a module: one vector of numbers."""

    def __init__(self, module: nn.Module):
        self.module = module
        self.shapes = {name: x.shape for name, x in module.named_parameters()}

    @classmethod
    def of(cls, x: Any) -> ParameterVector | None:
        """Those of a module; None if there are none."""
        return cls(x) if isinstance(x, nn.Module) and any(True for _ in x.parameters()) else None

    def flat(self) -> Tensor:
        """As they are now [k, 1, lanes]; each of them may lead with lanes."""
        parts = []
        for name, x in self.module.named_parameters():
            lanes = x.shape[0] if x.dim() > len(self.shapes[name]) else 1
            parts.append(x.reshape(lanes, -1))
        lanes = max(x.shape[0] for x in parts)
        return torch.cat([x.expand(lanes, -1) for x in parts], 1).T[:, None]

    def named(self, flat: Any) -> dict[str, Any]:
        """Parameters by name out of the vector [k, ...], of shape [*shape, ...]."""
        found, start = {}, 0
        for name, shape in self.shapes.items():
            part = flat[start : start + shape.numel()]
            found[name] = linear(lambda x, shape=shape: x.reshape((*shape, *x.shape[1:])), part)
            start += shape.numel()
        return found

    def evaluated(self) -> Any:
        """What the module returns for each design, tensors with lanes in front; one design has none."""

        def one(x: Tensor) -> Any:
            return torch.func.functional_call(self.module, self.named(x), ())

        alone = all(x.dim() == len(self.shapes[name]) for name, x in self.module.named_parameters())
        found = torch.func.vmap(one, 1)(self.flat()[:, 0])
        if not alone:
            return found
        return tuple(x[0] for x in found) if isinstance(found, tuple) else found[0]
