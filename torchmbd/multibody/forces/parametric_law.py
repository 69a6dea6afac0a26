"""Laws of forces with design variables: numbers of a law that are taken from the data of a design.

    f(s, s', t; b)     the law with its numbers [1, pair, lanes] in the places of its fields

`data["law NAME"]` holds those of the force NAME, flat [k, pair, lanes]. Such a law is evaluated on values and tangents
together, so it is compiled like any other.
Checked in tests/sensitivity/test_law_variables.py: against central differences, on both routes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

from torch import Tensor, nn

from torchmbd.math.variable import ParameterVector, is_variable, law_key
from torchmbd.multibody.forces.laws import OfTime, Scaled, Spring
from torchmbd.multibody.joints.laws import finite

_KINDS = (Spring, Scaled)


@dataclass(frozen=True)
class ParametricLaw:
    """A law, and which of its fields is which row of the data."""

    key: str
    rows: tuple[tuple[str, int], ...]
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
        return replace(self.law, **{field: numbers[i : i + 1] for field, i in self.rows})


class LawVariables:
    """The numbers that vary in the laws of the force `name`."""

    def __init__(self, name: str):
        self.name = name
        self._numbers = nn.ParameterDict()

    def law(self, law: Any, **names: str) -> Any:
        """The law with its numbers checked; those that vary are called as its fields, or by `names`."""
        if not isinstance(law, _KINDS):
            return law
        called = {f.name: names.get(f.name, f.name) for f in fields(law) if f.name != "law"}
        own = {field: finite(f"{label} of {self.name!r}", getattr(law, field)) for field, label in called.items()}
        rows = tuple((field, self._row(called[field], x)) for field, x in own.items() if is_variable(x))
        law = replace(law, **{field: x.item() if is_variable(x) else x for field, x in own.items()})
        return ParametricLaw(law_key(self.name), rows, law) if rows else law

    def law_of_time(self, x: Any, label: str, size: float = 1.0) -> Any:
        """The law size x(t) of a number, a variable called `label`, a function of time, or Scaled of one."""
        if isinstance(x, Scaled):
            return self.law(Scaled(x.factor, OfTime(x.law, size)))
        if callable(x):
            law: Any = x
            return OfTime(law, size)
        x = finite(f"{label} of {self.name!r}", x)
        return self.law(Scaled(x, OfTime(1.0, size)), factor=label) if is_variable(x) else OfTime(x, size)

    def _row(self, label: str, x: nn.Parameter) -> int:
        """Row of a variable among the data; one that comes again is the same."""
        for row, known in enumerate(self._numbers.values()):
            if known is x:
                return row
        self._numbers[label] = x
        return len(self._numbers) - 1

    @cached_property
    def variables(self) -> ParameterVector | None:
        """All of them when the force is complete, with the shapes of one design; None: there are none."""
        return ParameterVector.of(self._numbers)
