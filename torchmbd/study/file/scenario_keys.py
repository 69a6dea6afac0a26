"""The sections `scenarios` and `combine` of an experiment file, see schema.py.

    scenarios  [{name: heavy, set: {tool.mass: 0.4, arm.laminate.thickness: {value: 1.2, unit: mm}}, weight: 1}, ...]
    combine    {objective: worst | mean, constraints: each | worst | mean}

Checked in tests/study/file/test_same_in_python.py.
"""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator

from torchmbd.design.scenarios import CONSTRAINTS, OBJECTIVES
from torchmbd.math import units
from torchmbd.study.file.section import UNITS, NameOf, Numbers, Section, Unit, fault


class Setting(Section):
    """A value of a parameter in a scenario, with its unit; without a unit, as a number or a list, it is in SI units.

    value  one number, or a list
    unit   its unit
    """

    value: Numbers
    unit: Unit

    @property
    def si(self) -> Numbers:
        factor = UNITS[self.unit]
        return [factor * x for x in self.value] if isinstance(self.value, list) else factor * self.value


def _in_their_units(settings: dict[str, Numbers | Setting]) -> dict[str, Numbers | Setting]:
    for name, x in settings.items():
        if isinstance(x, Setting):
            if text := units.misfit(name, x.unit):
                raise fault(f"= {x.unit!r}", name, "unit", allowed=text)
        elif units.quantity(name) == "rad":
            allowed = f"{{value: {x}, unit: deg}}, or unit: rad"
            raise fault(f"= {x}", name, allowed="must have a unit, because it is an angle", hint=allowed)
    return settings


#: Values of parameters by name.
Settings = Annotated[dict[str, Numbers | Setting], AfterValidator(_in_their_units)]


def si_of(settings: Settings) -> dict[str, Numbers]:
    """The values of parameters [SI]."""
    return {name: x.si if isinstance(x, Setting) else x for name, x in settings.items()}


class Scenario(Section):
    """A scenario: values of parameters of the model that are not design variables, and its weight in means.

    name     its name; default: scenario 1, 2, ...
    set      parameters of the model that are not design variables, with their values [SI]; of angles with a unit
    options  other arguments of the model's function in this scenario: its topology may differ
    weight   its weight in means
    """

    name: str | None = None
    set: Settings = Field(default={})
    options: dict[str, Any] = Field(default={})
    weight: float = Field(default=1.0, ge=0)

    @model_validator(mode="after")
    def _sets_something(self) -> Self:
        if not self.set and not self.options:
            raise fault(": sets nothing", allowed="must have set, options or both")
        return self

    @property
    def settings(self) -> dict[str, Numbers]:
        """The values of parameters [SI]."""
        return si_of(self.set)


class Combine(Section):
    """How objective and constraints are combined over the scenarios."""

    objective: Annotated[str, NameOf(OBJECTIVES)] = OBJECTIVES[0]
    constraints: Annotated[str, NameOf(CONSTRAINTS)] = CONSTRAINTS[0]
