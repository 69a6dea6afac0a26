"""Laws of forces with design variables: the values of some fields of a law are data of a design.

    f(s, s', t; b)     the law with tensors or pairs [1, pair, lanes] as fields

`data["law NAME"]` holds those of the force NAME, flat [k, pair, lanes]. Such a law is evaluated on values and tangents at once,
so it is compiled like any other.
Checked in tests/sensitivity/test_law_variables.py: against central differences, on both routes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from torch import Tensor, nn

from torchmbd.math.variable import ParameterVector, is_variable, law_key
from torchmbd.multibody.forces.laws import LAWS, OfTime, Scaled, check_data_fields, data_fields
from torchmbd.multibody.joints.laws import finite


@dataclass(frozen=True)
class ParametricLaw:
    """A law whose fields, or some of them, are rows of the data `key`: pairs (name of the field, row)."""

    key: str
    rows: tuple[tuple[str, int], ...]
    law: Any

    @property
    def center(self) -> float:
        return self.law.center

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        """The law with the values that its fields were given."""
        return self.law(s, rate, t)

    def at(self, data: Mapping[str, Any]) -> Any:
        """The law with the values of the data."""
        numbers = data[self.key]
        return replace(self.law, **{field: numbers[i : i + 1] for field, i in self.rows})


def is_library_law(law: Any) -> bool:
    """True if a law is of this library and contains no function of a user."""
    if isinstance(law, (ParametricLaw, Scaled)):
        return is_library_law(law.law)
    return type(law) in LAWS and not callable(getattr(law, "law", None))


class LawVariables:
    """The design variables in the laws of the force `name`."""

    def __init__(self, name: str):
        self.name = name
        self._numbers = nn.ParameterDict()

    @property
    def numbers(self) -> Mapping[str, Tensor]:
        """The design variables by name, in the present design."""
        return dict(self._numbers.items())

    def law(self, law: Any, **names: str) -> Any:
        """The law with its numbers checked; design variables get the names of their fields, or those of field -> name."""
        if data_fields(law):
            check_data_fields(self.name, law)
        labels = {field: names.get(field, field) for field in data_fields(law)}
        numbers = {field: finite((self.name, label), getattr(law, field)) for field, label in labels.items()}
        rows = tuple((field, self._row(labels[field], x)) for field, x in numbers.items() if is_variable(x))
        if labels:  # else `law` may be anything, a tensor with a method `positive` too
            for sign in ("positive", "nonnegative"):
                varying = tuple(labels[field] for field in getattr(law, sign, ()) if is_variable(numbers[field]))
                setattr(self._numbers, sign, getattr(self._numbers, sign, ()) + varying)
            law = replace(law, **{field: x.item() if is_variable(x) else x for field, x in numbers.items()})
        return ParametricLaw(law_key(self.name), rows, law) if rows else law

    def law_of_time(self, x: Any, label: str, size: float = 1.0) -> Any:
        """The law f = size x(t); x: a number, a design variable of the name `label`, a function of time, or Scaled of one."""
        if isinstance(x, Scaled):
            return self.law(Scaled(x.factor, OfTime(x.law, size)))
        if callable(x):
            law: Any = x
            return OfTime(law, size)
        x = finite((self.name, label), x)
        return self.law(Scaled(x, OfTime(1.0, size)), factor=label) if is_variable(x) else OfTime(x, size)

    def _row(self, label: str, x: nn.Parameter) -> int:
        """Row of a design variable in the data; a Parameter that is given twice has one row."""
        for row, known in enumerate(self._numbers.values()):
            if known is x:
                return row
        self._numbers[label] = x
        return len(self._numbers) - 1

    @cached_property
    def variables(self) -> ParameterVector | None:
        """All design variables of the completed force, with the shapes of one design; None: there are none."""
        return ParameterVector.of(self._numbers)
