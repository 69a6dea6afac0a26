"""The experiment file as data: sections, types, ranges, and names that are known without the model.

    model      module:function or file.py:function that returns a System      options   its arguments
    design     parameter -> start, lower, upper, unit                        simulate  duration, method, steps, ...
    minimize   {integral: {strain_energy: rod}}                              subject_to  [{max: ..., at_most: initial}]
    optimizer  name, max_iterations, the method's own options                starts    sampler, count, seed, ...
    sweep      one design variable from .. to ..: evaluated as one batch, instead of optimizer and starts
    tracking   experiment, uri

Numbers of `design`, `starts.points` and `sweep` are in the unit of their variable; everything else is SI.
Pydantic validates strictly (no text for a number, no true for 1) and collects every fault; names of the model's own
parameters and bodies are checked in check.py. Checked in tests/experiment/test_load.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Annotated, Any, Literal, Self

from annotated_types import Len
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from torchmbd.design.responses import COMBINATORS, RESPONSES
from torchmbd.errors import nearest
from torchmbd.integrators import METHODS
from torchmbd.optimizers import OPTIMIZERS
from torchmbd.tracking.store import SCHEMES

UNITS = {"deg": math.pi / 180.0, "rad": 1.0, "m": 1.0, "mm": 1e-3, "none": 1.0}  # unit -> SI
SAMPLERS = ("sobol", "latin_hypercube", "given", "none")


def _one_of(names: Collection[str] | Callable[[], Collection[str]]) -> AfterValidator:
    """Accept a name of a registry only."""

    def check(name: str) -> str:
        allowed = names() if callable(names) else names
        if name not in allowed:
            raise PydanticCustomError("name", "{text}", {"text": nearest(name, allowed)[2:]})
        return name

    return AfterValidator(check)


Numbers = float | Annotated[list[float], Len(min_length=1)]
Response = Annotated[dict[Annotated[str, _one_of(RESPONSES)], str], Len(1, 1)]
Measure = Annotated[dict[Annotated[str, _one_of(COMBINATORS)], Response], Len(1, 1)]


class Section(BaseModel):
    """Part of a file: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Variable(Section):
    """A design variable; a single number serves every entry of the parameter."""

    start: Numbers | None = None  # default: as the model is built
    lower: Numbers
    upper: Numbers
    unit: Annotated[str, _one_of(UNITS)]  # without a default: 45 is a very different angle in radians


class Simulation(Section):
    """Arguments of torchmbd.simulate; more keys are options of the method."""

    model_config = ConfigDict(extra="allow")
    duration: float = Field(gt=0)
    method: Annotated[str, _one_of(METHODS)] = "generalized_alpha"
    steps: PositiveInt | None = None

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Constraint(Section):
    """`{max: {strain_energy: rod}, at_most: initial}`: at most its value at the start design, or a number [SI]."""

    measure: Measure
    at_most: Literal["initial"] | float

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "measure" in data:
            return data
        rest = {key: value for key, value in data.items() if key != "at_most"}
        return {"measure": rest} | {key: data[key] for key in ("at_most",) if key in data}


class Optimizer(Section):
    """Arguments of torchmbd.multistart; more keys are options of the method."""

    model_config = ConfigDict(extra="allow")
    name: Annotated[str, _one_of(OPTIMIZERS)] = "mmfd"
    max_iterations: PositiveInt = 30

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Starts(Section):
    """Where the optimizer starts: the design of the file (start 0) and more points between the bounds."""

    sampler: Annotated[str, _one_of(SAMPLERS)] = "none"
    count: PositiveInt | None = None  # of all starts, the initial design among them
    seed: NonNegativeInt = 0
    include_initial: bool = True
    points: Annotated[list[list[float]], Len(min_length=1)] | None = None

    @model_validator(mode="after")
    def _fits_the_sampler(self) -> Self:
        wanted = {"sobol": "count", "latin_hypercube": "count", "given": "points"}.get(self.sampler)
        for key in ("count", "points"):
            if (getattr(self, key) is not None) != (key == wanted):
                verb = "needs" if key == wanted else "takes no"
                raise PydanticCustomError("sampler", "{text}", {"text": f"sampler {self.sampler!r} {verb} {key!r}"})
        if self.sampler == "none" and not self.include_initial:
            raise PydanticCustomError("sampler", "sampler 'none' with include_initial: false leaves no start")
        return self


class Range(Section):
    """Values of a sweep, ends included, in the unit of the variable."""

    first: float = Field(alias="from")
    last: float = Field(alias="to")
    count: int = Field(ge=2, le=100_000)


class Tracking(Section):
    """Where the runs go; see torchmbd.tracking.store for the default."""

    experiment: Annotated[str, Len(1, 200)] = "torchmbd"
    uri: str | None = None

    @field_validator("uri")
    @classmethod
    def _known_scheme(cls, uri: str | None) -> str | None:
        scheme, separator, _ = (uri or "").partition(":")
        if uri is not None and (not separator or scheme.partition("+")[0] not in SCHEMES):
            text = f"a store is one of {', '.join(f'{name}:' for name in SCHEMES)} such as sqlite:///mlflow.db"
            raise PydanticCustomError("uri", "{text}", {"text": text})
        return uri


class Study(Section):
    """A whole experiment file."""

    model: Annotated[str, Field(pattern=r"^[^:]+(\.py)?:[A-Za-z_][A-Za-z0-9_]*$")]
    options: dict[str, Any] = {}
    design: Annotated[dict[str, Variable], Len(min_length=1)]
    simulate: Simulation
    minimize: Measure
    subject_to: list[Constraint] = []
    optimizer: Optimizer | None = None
    starts: Starts | None = None
    sweep: Annotated[dict[str, Range], Len(1, 1)] | None = None
    tracking: Tracking = Tracking()

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        extra = [key for key in ("optimizer", "starts") if getattr(self, key) is not None]
        if self.sweep is not None and extra:
            text = f"sweep and {' and '.join(extra)} are both given; allowed: a sweep, or an optimizer with starts"
            raise PydanticCustomError("kind", "{text}", {"text": text})
        return self

    def resolved(self) -> dict[str, Any]:
        """Return the file with every default filled in, in the form of the file."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        if self.sweep is None:
            data["optimizer"] = (self.optimizer or Optimizer()).model_dump(mode="json")
            data["starts"] = (self.starts or Starts()).model_dump(mode="json", exclude_none=True)
        data["subject_to"] = [c.measure | {"at_most": c.at_most} for c in self.subject_to]
        return data
