"""The sections `scenarios` and `combine` of an experiment file, see schema.py.

    scenarios  [{name: heavy, set: {tool.mass: 0.4, arm.laminate.thickness: {value: 1.2, unit: mm}}, weight: 1}, ...]
    combine    {objective: worst | mean, constraints: each | worst | mean}

Checked in tests/study/test_same_in_python.py.
"""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from torchmbd.design.scenarios import CONSTRAINTS, OBJECTIVES
from torchmbd.math import units
from torchmbd.study.section import UNITS, Numbers, Section, Unit, one_of


class Setting(Section):
    """A value of a parameter in a scenario, with its unit; without a unit, as a number or a list, it is in SI units."""

    value: Numbers = Field(description="One number, or a list.")
    unit: Unit = Field(description="Its unit.")

    @property
    def si(self) -> Numbers:
        one = UNITS[self.unit]
        return [one * x for x in self.value] if isinstance(self.value, list) else one * self.value


class Scenario(Section):
    """A scenario: values of parameters of the model that are no design variables, and its weight in means.

    With `options`, the model is built for it with these in place of those of the file; its topology may differ.
    """

    name: str | None = Field(default=None, description="Its name; default: scenario 1, 2, ...")
    set: dict[str, Numbers | Setting] = Field(
        default={},
        description="Parameters of the model that are no design variables, with their values [SI]; of angles with a unit.",
    )
    options: dict[str, Any] = Field(default={}, description="Other arguments of the model's function in this scenario.")
    weight: float = Field(default=1.0, ge=0, description="Its weight in means.")

    @model_validator(mode="after")
    def _sets_something(self) -> Self:
        if not self.set and not self.options:
            raise PydanticCustomError("kind", "sets nothing; must have set, options or both")
        for name, x in self.set.items():
            text = None
            if isinstance(x, Setting) and (fault := units.misfit(name, x.unit)):
                text = f"= {x.value} with unit: {x.unit}: {fault}"
            elif not isinstance(x, Setting) and units.QUANTITIES.get(name.rpartition(".")[2]) == "rad":
                text = f"= {x}: is an angle without a unit; allowed: {{value: {x}, unit: deg}}, or unit: rad"
            if text:
                raise PydanticCustomError("kind", "{text}", {"text": text, "path": ("set", name)})
        return self

    @property
    def settings(self) -> dict[str, Numbers]:
        """The values of parameters [SI]."""
        return {name: x.si if isinstance(x, Setting) else x for name, x in self.set.items()}


class Combine(Section):
    """How objective and constraints are combined over the scenarios."""

    objective: Annotated[str, one_of(OBJECTIVES)] = OBJECTIVES[0]
    constraints: Annotated[str, one_of(CONSTRAINTS)] = CONSTRAINTS[0]
