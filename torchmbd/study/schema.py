"""The experiment file as data: sections, types, ranges, and names that are known without the model.

    model      module:function or file.py:function that returns a System      options   its arguments
    design     parameter -> start, lower, upper, unit, tolerance, step       simulate  duration, method, steps, ...
    links      {entry: {entry: factor, constant: offset}}: entries of `design` that follow others, see design/space.py
    minimize   {integral: {strain_energy: rod}}, see design/response_spec.py          subject_to  [{max: ..., at_most: initial}]
    maximize   a response, instead of minimize
    tradeoff   {energy: {integral: ...}, mass: {mass: rod}}, instead of minimize: a Pareto front of these criteria
    robust     expected | worst: what is asked over the tolerances of `design`, see optimization/robust.py
    optimizer  name, max_iterations, the method's own options                starts    sampler, count, seed, ...
    scenarios  [{name: heavy, set: {tool.mass: 0.4}, weight: 1}, ...]: one design in all of them, see design/scenarios.py
    combine    {objective: worst | mean, constraints: each | worst | mean} over the scenarios
    sweep      one design variable from .. to ..: evaluated together, instead of optimizer and starts
    tracking   experiment, uri

or, for pictures that are no optimization,

    figures    module:function or file.py:function that draws into a folder  options   its arguments      tracking

Numbers of `design`, `links`, `starts.points` and `sweep` are in the unit of their variable, those of a constraint in its
`unit` (required for an angle); everything else is SI.
Pydantic validates strictly (no text for a number, no true for 1) and collects every fault; names of parameters and bodies of
the model are checked in check.py. Checked in tests/study/test_load.py.
Over 300 lines: a short class for each section of the file.
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
from pydantic_core import PydanticCustomError

from torchmbd.design.problem_steps import TOLERANCE
from torchmbd.design.response_spec import SpecError, measure_of
from torchmbd.design.words import unit
from torchmbd.integrate.arguments import BACKENDS, GRADIENTS
from torchmbd.integrate.registry import DEFAULT, METHODS
from torchmbd.math import units
from torchmbd.math.plausible_units import turn_in_radians
from torchmbd.multibody.system.start import STARTS
from torchmbd.optimization import OPTIMIZERS
from torchmbd.optimization.robust import KINDS as KINDS_OF_ROBUST
from torchmbd.study.scenario_keys import Combine, Scenario
from torchmbd.study.section import UNITS, Numbers, Section, one_of
from torchmbd.tracking.store import uri_fault
from torchmbd.tracking.uri import StoreURI

LIMIT_KINDS = ("at_most", "at_least", "equal")  # of constraints
FUNCTION = r"^[^:]+(\.py)?:[A-Za-z_][A-Za-z0-9_]*$"
_SHORTEST, _LONGEST = 1e-12, 1e9  # steps [s]
NAME = re.compile(r"[^\x00-\x1f]{1,200}")  # of experiments and studies
SAMPLERS = ("sobol", "latin_hypercube", "given", "none")


OBJECTIVE_KEYS = ("minimize", "maximize", "tradeoff")  # exactly one of them is given


def _fault(path: tuple[str | int, ...], text: str) -> PydanticCustomError:
    return PydanticCustomError("kind", "{text}", {"text": text, "path": path})


Limit = Literal["initial"] | float


def _readable(spec: dict[str, Any]) -> dict[str, Any]:
    try:
        measure_of(spec)
    except SpecError as error:
        raise PydanticCustomError("response", "{text}", {"text": error.text, "path": error.path}) from error
    return spec


Measure = Annotated[dict[str, Any], AfterValidator(_readable)]


class Variable(Section):
    """A design variable; a single number applies to every entry of the parameter. Entries that follow others have no numbers.

    With a tolerance the objective is the mean over deviations up to it, and constraints hold for all of these
    (optimization/robust.py). With a step the study ends with the best design whose variables are multiples of it
    (optimization/discrete/branch_and_bound.py).
    """

    start: Numbers | None = None  # default: as the model is built
    lower: Numbers | None = None  # required, unless every entry follows others
    upper: Numbers | None = None
    unit: Annotated[str, one_of(UNITS)]  # without a default: an angle of 45 in radians would be wrong
    tolerance: Numbers | None = None  # default: no deviation
    step: Numbers | None = None  # 0, and default: any value

    @field_validator("tolerance", "step")
    @classmethod
    def _not_negative(cls, given: Numbers | None) -> Numbers | None:
        if given is not None and min(given if isinstance(given, list) else [given]) < 0.0:
            raise PydanticCustomError("value", "must not be negative")
        return given


class Simulation(Section):
    """Arguments of torchmbd.simulate; more keys are options of the method."""

    model_config = ConfigDict(extra="allow")
    duration: float = Field(gt=0)
    method: Annotated[str, one_of(METHODS)] = DEFAULT
    steps: PositiveInt | None = None
    tolerance: float = Field(TOLERANCE, gt=0, lt=1)  # error by steps of responses, where `steps` is left out
    phases: str | None = None  # module:function that returns the phases, list[mbd.Phase]
    backend: Annotated[str, one_of(BACKENDS)] = "auto"  # of the steps
    start: Annotated[str, one_of(STARTS)] | dict[str, list[float]] = STARTS[0]  # of every motion
    gradients: Annotated[str, one_of(GRADIENTS[:-1])] = "auto"  # by the adjoint (reverse) or tangents (forward)

    @model_validator(mode="after")
    def _steps_that_numbers_hold(self) -> Self:
        step = self.duration / (self.steps or 1)
        if not _SHORTEST <= step <= _LONGEST:
            text = f"has steps of {step:.3g} s; allowed: {_SHORTEST:g} to {_LONGEST:g} s"
            raise PydanticCustomError("kind", "{text}", {"text": text})
        return self

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Constraint(Section):
    """`{max: {strain_energy: rod}, at_most: initial}`: a response and a limit, its value at the start or a number.

    A number is in the `unit` of the constraint; without one it is in SI units. Of an angle the unit must be given.
    """

    measure: Measure
    at_most: Limit | None = None
    at_least: Limit | None = None
    equal: Limit | None = None
    scale: float | None = Field(default=None, gt=0)  # what a violation is divided by; default: the limit
    unit: Annotated[str, one_of(UNITS)] | None = None  # of limit and scale; default: SI

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "measure" in data:
            return data
        own = (*LIMIT_KINDS, "scale", "unit")
        rest = {key: value for key, value in data.items() if key not in own}
        return {"measure": rest} | {key: data[key] for key in own if key in data}

    @model_validator(mode="after")
    def _one_limit(self) -> Self:
        given = [key for key in LIMIT_KINDS if getattr(self, key) is not None]
        if len(given) != 1:
            text = f"has {' and '.join(given) or 'no limit'}; must have exactly one of {', '.join(LIMIT_KINDS)}"
            raise PydanticCustomError("kind", "{text}", {"text": text})
        return self

    @model_validator(mode="after")
    def _unit_of_the_response(self) -> Self:
        si = unit(measure_of(self.measure))
        numbers = [x for x in (self.limit, self.scale) if isinstance(x, float)]
        if self.unit is None:
            if si == "rad" and numbers:
                text = f"has a limit of an angle ({numbers[0]:g}) and no unit; must have unit: deg or unit: rad"
                raise PydanticCustomError("kind", "{text}", {"text": text})
        elif si is not None and units.UNITS[self.unit][1] != si:
            allowed = ", ".join(units.units_of(si)) or f"none: limits are in {si}"
            text = f"has unit: {self.unit}, and a response in {si or 'plain numbers'}; allowed: {allowed}"
            raise PydanticCustomError("kind", "{text}", {"text": text})
        if self.unit == "deg" and (said := turn_in_radians(numbers[:1])):
            text = f"has unit: deg, and {said}; allowed: degrees, or unit: rad"
            raise PydanticCustomError("kind", "{text}", {"text": text})
        return self

    @property
    def factor(self) -> float:
        """The factor from the unit of limit and scale to SI."""
        return 1.0 if self.unit is None else UNITS[self.unit]

    @property
    def kind(self) -> str:
        return next(key for key in LIMIT_KINDS if getattr(self, key) is not None)

    @property
    def limit(self) -> float | str:
        return getattr(self, self.kind)

    def resolved(self) -> dict[str, Any]:
        """Return the constraint in the form of the file."""
        own = {key: given for key in ("scale", "unit") if (given := getattr(self, key)) is not None}
        return {**self.measure, self.kind: self.limit, **own}

    def si(self, x: float | str | None) -> Any:
        """A limit or a scale in SI units; a word as it is."""
        return x * self.factor if isinstance(x, float) else x


class Optimizer(Section):
    """Arguments of torchmbd.multistart; more keys are options of the method."""

    model_config = ConfigDict(extra="allow")
    name: Annotated[str, one_of(OPTIMIZERS)] = "mmfd"
    max_iterations: PositiveInt = 60

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Starts(Section):
    """Where the optimizer starts: the design of the file (start 0) and more points between the bounds."""

    sampler: Annotated[str, one_of(SAMPLERS)] = "none"
    count: Annotated[PositiveInt, Field(le=2**20)] | None = None  # of all starts, the initial design among them
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
                text = f"sampler {self.sampler!r} {verb} {key!r}; allowed: {allowed}"
                raise PydanticCustomError("sampler", "{text}", {"text": text})
        if self.sampler == "none" and not self.include_initial:
            raise PydanticCustomError(
                "sampler", "sampler 'none' with include_initial: false leaves no start; allowed: include_initial: true"
            )
        return self


class Range(Section):
    """Values of a sweep, ends included, in the unit of the variable."""

    first: float = Field(alias="from")
    last: float = Field(alias="to")
    count: int = Field(ge=2, le=100_000)


def _known_store(given: Any) -> StoreURI:
    if not isinstance(given, str):
        raise PydanticCustomError("uri", "must be a valid string")
    uri = StoreURI(given)
    if fault := uri_fault(uri):
        raise PydanticCustomError("uri", "{text}", {"text": fault})
    return uri


Store = Annotated[
    StoreURI, PlainValidator(_known_store, json_schema_input_type=str), PlainSerializer(str, return_type=str)
]


class Tracking(Section):
    """Where the runs go; see torchmbd.tracking.store for the default."""

    experiment: Annotated[str, Len(1, 200), Field(pattern=r"^[^\x00-\x1f]+$")] = "torchmbd"
    uri: Store | None = None


class Figures(Section):
    """An experiment file that draws figures."""

    figures: Annotated[str, Field(pattern=FUNCTION)]
    options: dict[str, Any] = Field(default={})
    tracking: Tracking = Tracking()

    def resolved(self) -> dict[str, Any]:
        """Return the file with every default filled in."""
        return self.model_dump(mode="json", exclude_none=True)


class StudyFile(Section):
    """An experiment file that optimizes, or sweeps a variable."""

    model: Annotated[str, Field(pattern=FUNCTION)]
    options: dict[str, Any] = Field(default={})
    design: Annotated[dict[str, Variable], Len(min_length=1)]
    links: dict[str, Annotated[dict[str, float], Len(min_length=1)]] = Field(default={})
    simulate: Simulation
    minimize: Measure | None = None
    maximize: Measure | None = None
    tradeoff: Annotated[dict[str, Measure], Len(min_length=2)] | None = None
    robust: Annotated[str, one_of(KINDS_OF_ROBUST)] | None = None  # default: expected, where there are tolerances
    subject_to: list[Constraint] = Field(default=[])
    scenarios: Annotated[list[Scenario], Len(min_length=1)] | None = None
    combine: Combine | None = None
    optimizer: Optimizer | None = None
    starts: Starts | None = None
    sweep: Annotated[dict[str, Range], Len(1, 1)] | None = None
    tracking: Tracking = Tracking()

    @model_validator(mode="after")
    def _one_question(self) -> Self:
        given = [key for key in OBJECTIVE_KEYS if getattr(self, key) is not None]
        if not given:
            text = "is missing; allowed: a response, such as {integral: {strain_energy: rod}}, or instead of it "
            raise _fault(("minimize",), text + " or ".join(f"{key}:" for key in OBJECTIVE_KEYS[1:]))
        if len(given) > 1:
            raise _fault((given[1],), f"and {given[0]} are both given; allowed: one of {', '.join(OBJECTIVE_KEYS)}")
        tolerant = any(variable.tolerance is not None for variable in self.design.values())
        if self.robust is not None and not tolerant:
            raise _fault(("robust",), f"= {self.robust!r}: no variable has a tolerance; allowed: with one in design")
        if self.tradeoff is not None:
            others = [key for key in ("scenarios", "sweep") if getattr(self, key) is not None]
            others += [key for key in ("tolerance", "step") if any(getattr(v, key) for v in self.design.values())]
            if others:
                raise _fault(("tradeoff",), f"and {others[0]} are both given; allowed: one of them")
            if any(constraint.kind == "equal" for constraint in self.subject_to):
                raise _fault(("tradeoff",), "and a constraint with equal are both given; allowed: at_most, at_least")
        return self

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        extra = [key for key in ("optimizer", "starts") if getattr(self, key) is not None]
        if self.sweep is not None and extra:
            text = f"sweep and {' and '.join(extra)} are both given; allowed: a sweep, or an optimizer with starts"
            raise PydanticCustomError("kind", "{text}", {"text": text})
        if self.combine is not None and self.scenarios is None:
            raise PydanticCustomError("kind", "combine is given without scenarios; allowed: both, or none")
        if self.sweep is not None and self.scenarios is not None:
            raise PydanticCustomError("kind", "sweep and scenarios are both given; allowed: one of them")
        names = [scenario.name for scenario in self.scenarios or () if scenario.name is not None]
        if len({*names}) < len(names):
            text = f"scenarios have the names {names}; allowed: each name once"
            raise PydanticCustomError("kind", "{text}", {"text": text})
        for key in ("tolerance", "step"):
            if self.sweep is not None and any(getattr(variable, key) is not None for variable in self.design.values()):
                text = f"sweep and a {key} are both given; allowed: one of them"
                raise PydanticCustomError("kind", "{text}", {"text": text})
        return self

    def resolved(self) -> dict[str, Any]:
        """Return the file with every default filled in, in the form of the file."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        if self.sweep is None:
            data["optimizer"] = (self.optimizer or Optimizer()).model_dump(mode="json")
            data["starts"] = (self.starts or Starts()).model_dump(mode="json", exclude_none=True)
        data["subject_to"] = [constraint.resolved() for constraint in self.subject_to]
        return data
