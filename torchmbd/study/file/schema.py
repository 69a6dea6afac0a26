"""The experiment file as data: sections, types, ranges, units, and which keys exclude each other.

What a constructor of torchmbd checks is not checked here. A key that is an argument of a constructor, in the same form, is
described in its docstring; other keys are in the docstrings of the sections (json_schema.py).
Numbers of `design`, `links`, `starts.points` and `sweep` are in the unit of their variable, those of a constraint in its
`unit` (required for an angle); everything else is SI.
Pydantic validates strictly (no text for a number, no true for 1) and collects every fault.
Checked in tests/study/file/test_load.py.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, Self

from annotated_types import Len
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    NonNegativeInt,
    PlainSerializer,
    PlainValidator,
    PositiveInt,
    field_validator,
    model_validator,
)

from torchmbd.design.problem_steps import TOLERANCE
from torchmbd.design.response_spec import SpecError, measure_of
from torchmbd.design.words import unit
from torchmbd.integrate.arguments import GRADIENTS
from torchmbd.integrate.backend import BACKENDS
from torchmbd.integrate.registry import DEFAULT, METHODS
from torchmbd.math import units
from torchmbd.math.plausible_units import turn_in_radians
from torchmbd.multibody.start.start import STARTS
from torchmbd.optimization import OPTIMIZERS
from torchmbd.optimization.optimizer import DEFAULT_METHOD
from torchmbd.optimization.robust import KINDS as KINDS_OF_ROBUST
from torchmbd.study.file.faults import shown
from torchmbd.study.file.scenario_keys import Combine, Scenario, Settings
from torchmbd.study.file.section import UNITS, NameOf, Numbers, Section, Unit, beside, fault
from torchmbd.tracking.store import uri_fault
from torchmbd.tracking.uri import StoreURI

LIMIT_KINDS = ("at_most", "at_least", "equal")  # of constraints
FUNCTION = r"^[^:]+(\.py)?:[A-Za-z_][A-Za-z0-9_]*$"
NAME = re.compile(r"[^\x00-\x1f]{1,200}")  # of experiments and studies
SAMPLERS = ("sobol", "latin_hypercube", "given", "none")


OBJECTIVE_KEYS = ("minimize", "maximize", "tradeoff")  # exactly one of them is given
#: Key -> what a file has not beside it.
_EXCLUSIVE = {
    "maximize": ("minimize",),
    "tradeoff": ("minimize", "maximize", "scenarios", "tolerance"),
    "sweep": ("optimizer", "starts", "scenarios"),
}
Limit = Literal["initial"] | float


def _readable(spec: dict[str, Any]) -> dict[str, Any]:
    try:
        measure_of(spec)
    except SpecError as error:
        raise fault(error.reason, *error.path, kind="response") from error
    return spec


Measure = Annotated[dict[str, Any], AfterValidator(_readable)]


class Bounded(Section):
    """Numbers of the entries of a parameter; a single number applies to every entry.

    start  first value, one or a list; default: as the model is built
    lower  lower bound, one or a list
    upper  upper bound, one or a list
    unit   unit of all numbers of this variable; `none`: the SI unit
    """

    start: Numbers | None = None
    lower: Numbers | None = None
    upper: Numbers | None = None
    unit: Unit  # without a default: an angle of 45 in radians would be wrong

    @model_validator(mode="after")
    def _bounds_in_degrees(self) -> Self:
        for key in ("lower", "upper") if self.unit == "deg" else ():
            x = getattr(self, key)
            if x is not None and (text := turn_in_radians(x if isinstance(x, list) else [x])):
                raise fault(f"= {x} with unit: deg: {text}", key, allowed="in degrees", hint="unit: rad")
        return self


class Variable(Bounded):
    """A design variable; a single number applies to every entry of the parameter. Entries that follow others have no numbers.

    start      first value, one or a list; default: as the model is built
    lower      lower bound, one or a list
    upper      upper bound, one or a list
    unit       unit of all numbers of this variable; `none`: the SI unit
    tolerance  largest deviation when it is made; the question is then asked over all deviations (optimization/robust.py)
    step       the study ends with multiples of it (optimization/discrete/branch_and_bound.py); 0: any value
    """

    # lower and upper are required, unless every entry follows others.
    tolerance: Numbers | None = None
    step: Numbers | None = None

    @field_validator("tolerance", "step")
    @classmethod
    def _not_negative(cls, numbers: Numbers | None) -> Numbers | None:
        if numbers is not None and min(numbers if isinstance(numbers, list) else [numbers]) < 0.0:
            raise fault(f"= {shown(numbers)}", allowed="must not be negative")
        return numbers


def units_fit(design: dict[str, Any]) -> dict[str, Any]:
    """Refuse a unit that a parameter of this name cannot have."""
    for name, variable in design.items():
        if text := units.misfit(name, variable.unit):
            raise fault(f"= {variable.unit!r}", name, "unit", allowed=text)
    return design


class Motion(Section):
    """Arguments of torchmbd.simulate; more keys are options of the method.

    phases  function that returns the phases: path/to/file.py:function or package.module:function
    start   `assembled`: undeformed; `equilibrium`: at rest under its loads; or values by name
    """

    model_config = ConfigDict(extra="allow")
    method: Annotated[str, NameOf(METHODS)] = DEFAULT
    steps: PositiveInt | None = None
    phases: str | None = None
    backend: str = Field(default="auto", json_schema_extra={"enum": ["auto", *BACKENDS]})
    start: Annotated[str, NameOf(STARTS)] | dict[str, list[float]] = STARTS[0]

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Simulation(Motion):
    """Arguments of torchmbd.simulate; more keys are options of the method.

    phases  function that returns the phases: path/to/file.py:function or package.module:function
    start   `assembled`: undeformed; `equilibrium`: at rest under its loads; or values by name
    """

    duration: float = Field(gt=0)
    tolerance: float = Field(default=TOLERANCE, gt=0, lt=1)
    gradients: Annotated[str, NameOf(GRADIENTS[:-1])] = "auto"


class Constraint(Section):
    """A response and a limit: `{max: {strain_energy: rod}, at_most: initial}`.

    at_most   largest allowed value; `initial`: the value at the start design
    at_least  smallest allowed value; `initial`: the value at the start design
    equal     required value; `initial`: the value at the start design
    unit      unit of limit and scale; default: SI; an angle needs one
    """

    model_config = beside("measure", "Measure")
    measure: Measure
    at_most: Limit | None = None
    at_least: Limit | None = None
    equal: Limit | None = None
    scale: float | None = Field(default=None, gt=0)
    unit: Unit | None = None

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "measure" in data:
            return data
        limit = {key: data[key] for key in (*LIMIT_KINDS, "scale", "unit") if key in data}
        return {"measure": {key: x for key, x in data.items() if key not in limit}} | limit

    @model_validator(mode="after")
    def _one_limit_in_its_unit(self) -> Self:
        kinds = [key for key in LIMIT_KINDS if getattr(self, key) is not None]
        if len(kinds) != 1:
            raise fault(
                f": has {' and '.join(kinds) or 'no limit'}",
                allowed=f"must have exactly one of {', '.join(LIMIT_KINDS)}",
            )
        si = unit(measure_of(self.measure))
        numbers = [x for x in (self.limit, self.scale) if isinstance(x, float)]
        if self.unit is None and si == "rad" and numbers:
            raise fault(
                f": has a limit of an angle ({numbers[0]:g}) and no unit", allowed="must have unit: deg or unit: rad"
            )
        if self.unit is not None and si is not None and units.UNITS[self.unit][1] != si:
            allowed = ", ".join(units.units_of(si)) or f"none, because limits are in {si}"
            raise fault(
                f": has unit: {self.unit}, and a response in {si or 'plain numbers'}",
                allowed=f"must have one of the units {allowed}",
            )
        if self.unit == "deg" and (said := turn_in_radians(numbers[:1])):
            raise fault(f": has unit: deg, and {said}", allowed="in degrees", hint="unit: rad")
        return self

    @property
    def kind(self) -> str:
        return next(key for key in LIMIT_KINDS if getattr(self, key) is not None)

    @property
    def limit(self) -> float | str:
        return getattr(self, self.kind)

    def resolved(self) -> dict[str, Any]:
        """Return the constraint in the form of the file."""
        scale_and_unit = {key: value for key in ("scale", "unit") if (value := getattr(self, key)) is not None}
        return {**self.measure, self.kind: self.limit, **scale_and_unit}

    def si(self, x: float | str | None) -> Any:
        """A limit or a scale in SI units; a word as it is."""
        return x * UNITS[self.unit] if isinstance(x, float) and self.unit is not None else x


class Optimizer(Section):
    """Arguments of torchmbd.optimization.multistart; more keys are options of the method.

    name  its name; more keys of this section are its options
    """

    model_config = ConfigDict(extra="allow")
    name: Annotated[str, NameOf(OPTIMIZERS)] = DEFAULT_METHOD
    max_iterations: PositiveInt = 60

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Starts(Section):
    """Starts of the optimizer: the design of the file (start 0) and more points between the bounds.

    sampler  `sobol` or `latin_hypercube` points between the bounds, `given` points, or `none`: the first design alone
    points   the points of `given`: a list of numbers for each, in the units of `design`
    """

    sampler: Annotated[str, NameOf(SAMPLERS)] = "none"
    count: Annotated[PositiveInt, Field(le=2**20)] | None = None
    seed: NonNegativeInt = 0
    include_initial: bool = True
    points: Annotated[list[list[float]], Len(min_length=1)] | None = None

    @model_validator(mode="after")
    def _fits_the_sampler(self) -> Self:
        wanted = {"sobol": "count", "latin_hypercube": "count", "given": "points"}.get(self.sampler)
        for key in ("count", "points"):
            if (getattr(self, key) is not None) != (key == wanted):
                verb = "needs" if key == wanted else "takes no"
                allowed = "sobol and latin_hypercube with count, given with points"
                raise fault(f": sampler {self.sampler!r} {verb} {key!r}", allowed=allowed)
        if self.sampler == "none" and not self.include_initial:
            allowed = "include_initial: true"
            raise fault(": sampler 'none' with include_initial: false leaves no start", allowed=f"must have {allowed}")
        return self


class Range(Section):
    """Values of a sweep.

    from   first value, in the unit of the variable
    to     last value
    count  number of values, ends included
    """

    first: float = Field(alias="from")
    last: float = Field(alias="to")
    count: int = Field(ge=2, le=100_000)


def _known_store(uri_text: Any) -> StoreURI:
    if not isinstance(uri_text, str):
        raise fault(f"= {shown(uri_text)}", allowed="a valid string")
    uri = StoreURI(uri_text)
    if refusal := uri_fault(uri):
        allowed, hint = refusal
        raise fault(f"= {shown(str(uri))}", allowed=allowed, hint=hint)
    return uri


Store = Annotated[
    StoreURI, PlainValidator(_known_store, json_schema_input_type=str), PlainSerializer(str, return_type=str)
]


class Tracking(Section):
    """The store of the runs; torchmbd.tracking.store states the default."""

    experiment: Annotated[str, Len(1, 200), Field(pattern=r"^[^\x00-\x1f]+$")] = "torchmbd"
    uri: Store | None = None


class StudyFile(Section):
    """An experiment file that optimizes, or sweeps a variable.

    model       the function that returns the System: path/to/file.py:function or package.module:function
    options     arguments of the model's function
    parameters  parameters of the model with other values, or the file that has them, as an identification writes it
    design      design variables: parameters of the model with bounds and a unit
    links       entries of `design` that follow others: entry -> {entry: factor, constant: offset}
    simulate    the motion: duration, steps, start, method
    tradeoff    named responses whose Pareto front is searched for; replaces `minimize`
    robust      what is asked over the tolerances of `design`: `expected`, the mean, or `worst`
    subject_to  constraints, all of which hold
    scenarios   load cases or settings in which one design is simulated
    combine     what is asked of objective and constraints over the scenarios
    optimizer   the method of optimization with its options
    starts      designs from which the optimizer starts
    sweep       one entry of `design` with a range: evaluated along it; replaces `optimizer` and `starts`
    tracking    where MLflow keeps the runs
    """

    model: Annotated[str, Field(pattern=FUNCTION)]
    options: dict[str, Any] = Field(default={})
    design: Annotated[dict[str, Variable], Len(min_length=1), AfterValidator(units_fit)]
    links: dict[str, Annotated[dict[str, float], Len(min_length=1)]] = Field(default={})
    simulate: Simulation
    minimize: Measure | None = None
    maximize: Measure | None = None
    tradeoff: Annotated[dict[str, Measure], Len(min_length=2)] | None = None
    robust: Annotated[str, NameOf(KINDS_OF_ROBUST)] | None = None  # default: expected, where there are tolerances
    subject_to: list[Constraint] = Field(default=[])
    scenarios: Annotated[list[Scenario], Len(min_length=1)] | None = None
    combine: Combine | None = None
    optimizer: Optimizer | None = None
    starts: Starts | None = None
    sweep: Annotated[dict[str, Range], Len(1, 1)] | None = None
    parameters: Settings = Field(default={})
    tracking: Tracking = Tracking()

    @model_validator(mode="after")
    def _one_question(self) -> Self:
        keys = {key for key in type(self).model_fields if getattr(self, key) is not None}
        keys |= {"tolerance"} if any(variable.tolerance is not None for variable in self.design.values()) else set()
        if not keys & {*OBJECTIVE_KEYS}:
            others = " or ".join(f"{key}:" for key in OBJECTIVE_KEYS[1:])
            allowed = f"a response, such as {{integral: {{strain_energy: rod}}}}, or instead of it {others}"
            raise fault("is missing", "minimize", allowed=allowed)
        for key in (key for key in _EXCLUSIVE if key in keys):
            if others := [other for other in _EXCLUSIVE[key] if other in keys]:
                raise fault(f"and {' and '.join(others)} are both given", key, allowed="must not be given together")
        if "robust" in keys and "tolerance" not in keys:
            raise fault(f"= {self.robust!r}", "robust", allowed="must have a variable with a tolerance in design")
        if "combine" in keys and "scenarios" not in keys:
            raise fault("is given without scenarios", "combine", allowed="given with them")
        names = [scenario.name for scenario in self.scenarios or () if scenario.name is not None]
        if len({*names}) < len(names):
            raise fault(f": have the names {names}", "scenarios", allowed="must have each name once")
        return self

    def resolved(self) -> dict[str, Any]:
        """Return the file with every default filled in, in the form of the file."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        if self.sweep is None:
            data["optimizer"] = (self.optimizer or Optimizer()).model_dump(mode="json")
            data["starts"] = (self.starts or Starts()).model_dump(mode="json", exclude_none=True)
        if not self.parameters:
            del data["parameters"]
        data["subject_to"] = [constraint.resolved() for constraint in self.subject_to]
        return data
