"""Laws of forces with design variables: numbers of a law that are taken from the data of a design.

    f(s, s', t; b)     the law with its numbers [1, slots, lanes] in the places of its fields

`data["law NAME"]` holds those of the force NAME, flat [k, slots, lanes]. Such a law is evaluated on values and tangents
together, so it is compiled like any other.
Checked in tests/sensitivity/test_law_variables.py: against central differences, on both routes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from torch import Tensor, nn

from torchmbd.forces.laws import Scaled, Spring
from torchmbd.joints.laws import finite
from torchmbd.numerics.variable import Variables, is_variable, key

_KINDS = (Spring, Scaled)


@dataclass(frozen=True)
class Varied:
    """A law, and which of its fields are which row of the data."""

    key: str
    rows: tuple[str, ...]
    law: Any

    @property
    def center(self) -> float:
        return self.law.center

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        """As it was given."""
        return self.law(s, rate, t)

    def at(self, data: Mapping[str, Any]) -> Any:
        """The law of a design."""
        numbers = data[self.key]
        return replace(self.law, **{name: numbers[i : i + 1] for i, name in enumerate(self.rows)})


class _Numbers(nn.Module):
    """Parameters by the names of the fields."""

    def __init__(self, numbers: Mapping[str, nn.Parameter]):
        super().__init__()
        for name, x in numbers.items():
            self.register_parameter(name, x)


def split(name: str, law: Any) -> tuple[Any, Variables | None]:
    """The law of the force `name` and its design variables, if it has some."""
    if not isinstance(law, _KINDS):
        return law, None
    own = {f.name: finite(f"{f.name} of {name!r}", getattr(law, f.name)) for f in fields(law) if f.name != "law"}
    law = replace(law, **{field: float(x) for field, x in own.items()})
    moving = {field: x for field, x in own.items() if is_variable(x)}
    if not moving:
        return law, None
    return Varied(key(name), tuple(moving), law), Variables(_Numbers(moving))
