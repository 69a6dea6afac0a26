"""An experiment file that fits a model to measurements: the section `identify`, see schema.py.

Numbers of an unknown are in its unit; deviation and offset of a channel are in the unit of the channel, delays in seconds;
everything else is SI. Checked in tests/extensions/identification/test_files.py.
"""

from __future__ import annotations

from typing import Annotated, Any, Self

from annotated_types import Len
from pydantic import AfterValidator, Field, PositiveInt, model_validator

from torchmbd.design.response_spec import SpecError, history_of
from torchmbd.extensions.identification.frequency_response_data import PARTS
from torchmbd.extensions.identification.least_squares import TOLERANCE
from torchmbd.extensions.identification.losses import LOSSES
from torchmbd.extensions.identification.registry import MEASUREMENTS
from torchmbd.extensions.vibrations.frequency_response import QUANTITIES
from torchmbd.study.file.scenario_keys import Settings
from torchmbd.study.file.schema import FUNCTION, Bounded, Motion, Starts, Tracking, units_fit
from torchmbd.study.file.section import NameOf, Numbers, Section, Unit, beside, fault

_OF_CHANNEL = ("column", "unit", "deviation", "delay", "gain", "offset")


def _readable(spec: dict[str, Any]) -> dict[str, Any]:
    try:
        history_of(spec)
    except SpecError as error:
        raise fault(error.reason, *error.path, kind="response") from error
    return spec


class Prior(Section):
    """The distribution of an unknown before any measurement.

    mean       its mean, in the unit of the unknown
    deviation  its standard deviation
    """

    mean: Numbers
    deviation: Numbers


class Unknown(Bounded):
    """An unknown: a parameter of the model, or a number of a sensor: `CHANNEL.delay`, `CHANNEL.gain`, `CHANNEL.offset`.

    With several experiments, the names of sensors are `EXPERIMENT.CHANNEL.delay` and so on.

    start  first value, one or a list; default: as the model is built
    lower  lower bound, one or a list; default: none. A delay needs both
    upper  upper bound, one or a list; default: none
    unit   unit of all numbers of this unknown; `none`: the SI unit
    prior  mean and standard deviation that are known before
    scale  size of its changes; default: that of its start, or by the data where the start is zero or tiny
    """

    prior: Prior | None = None
    scale: Numbers | None = None


class ChannelData(Section):
    """A column of a file and the response of the model that it shows: `{angle: {...}, unit: deg, deviation: 0.1}`.

    response   the response of the model; stands beside the other keys
    column     name of the column; default: that of the channel
    unit       unit of the column; default: that in brackets of its heading, else SI
    deviation  standard deviation of the noise, in `unit`, else SI; default: estimated
    delay      of the sensor [s], or the unknown of another channel, `CHANNEL.delay`, if both have the same delay
    gain       factor of the sensor, or the unknown of another channel, `CHANNEL.gain`
    offset     of the sensor, in `unit`, else SI; or the unknown of another channel, `CHANNEL.offset`
    """

    model_config = beside("response", "History")
    response: Annotated[dict[str, Any], AfterValidator(_readable)]
    column: str | None = None
    unit: Unit | None = None
    deviation: float | None = Field(default=None, gt=0)
    delay: float | str = 0.0
    gain: float | str = 1.0
    offset: float | str = 0.0

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "response" in data:
            return data
        keys = {key: data[key] for key in _OF_CHANNEL if key in data}
        return {"response": {key: x for key, x in data.items() if key not in keys}} | keys


class TimeSeriesData(Section):
    """Channels over time in a file.

    file      CSV file, relative to the experiment file
    channels  name -> response with its unit and deviation
    time      name of the column of times
    """

    file: str
    channels: Annotated[dict[str, ChannelData], Len(min_length=1)]
    time: str = "t"


class StaticCurveData(Section):
    """Channels at rest under several loads in a file.

    file      CSV file, relative to the experiment file
    loads     parameter of the model -> name of the column with its values
    channels  name -> response with its unit and deviation; without delay
    """

    file: str
    loads: Annotated[dict[str, str], Len(min_length=1)]
    channels: Annotated[dict[str, ChannelData], Len(min_length=1)]


class ModalDataKeys(Section):
    """Arguments of torchmbd.identification.ModalData: frequencies, damping ratios and mode shapes of small vibrations.

    frequencies  of the modes [Hz], ascending
    damping      damping ratios [-]; null where there is none
    shapes       for each sensor its numbers in all modes
    sensors      position responses: {position: {body: arm, axis: z, node: right}}
    """

    frequencies: Annotated[list[float], Len(min_length=1)]
    damping: list[float | None] | None = None
    shapes: list[list[float]] | None = None
    sensors: list[dict[str, Any]] = Field(default=[])
    modes: list[PositiveInt] | None = None
    frequency_share: float = Field(default=0.01, gt=0)
    damping_share: float = Field(default=0.1, gt=0)
    least_mac: float | None = Field(default=None, gt=0, lt=1)


class PortKeys(Section):
    """A joint, or a point of a body in a direction.

    name       of a joint (its motor, its angle or travel), or of a body
    direction  `x`, `y` or `z` of the ground, of the force or the position of a body
    place      a node of a flexible body, or x, y, z on a rigid one [m]; default: its origin
    """

    name: str
    direction: str | None = None
    place: str | int | list[float] | None = None


class FrequencyResponseKeys(Section):
    """Arguments of torchmbd.identification.FrequencyResponseData: amplitudes of outputs by that of an input, in a file.

    file       CSV file, relative to the experiment file
    input      where the input acts: {name: hinge}, or {name: load, direction: y, place: [0.1, 0, 0]}
    outputs    name -> where it is measured, as `input`; the file has two columns for each, "NAME real" and "NAME imaginary"
    frequency  name of the column of frequencies
    quantity   `displacement`, or its rates `velocity` and `acceleration`
    form       `complex`, or `polar` for columns "NAME magnitude" and "NAME phase"
    deviation  output -> standard deviation of both parts; default: estimated
    spin       of a steady rotation, in ground axes [rad/s]
    """

    file: str
    input: PortKeys
    outputs: Annotated[dict[str, PortKeys], Len(min_length=1)]
    frequency: str = "frequency"
    quantity: Annotated[str, NameOf(QUANTITIES)] = QUANTITIES[0]
    form: Annotated[str, NameOf(PARTS)] = "complex"
    deviation: dict[str, float] = Field(default={})
    spin: Annotated[list[float], Len(3, 3)] | None = None


class ExperimentData(Section):
    """An experiment: what was measured, in one or several kinds, and in what it differs from the others.

    time_series   channels over time
    static_curve  channels at rest under several loads
    modal_data    frequencies, damping ratios and mode shapes
    frequency_responses   amplitudes of outputs by that of an input
    set          parameters of the model that are not unknowns, with their values [SI]; of angles with a unit
    options      other arguments of the model's function in this experiment
    duration     of the motion [s]; default: until the last measured time
    start        instead of that of `simulate`
    """

    time_series: TimeSeriesData | None = None
    static_curve: StaticCurveData | None = None
    modal_data: ModalDataKeys | None = None
    frequency_responses: FrequencyResponseKeys | None = None
    set: Settings = Field(default={})
    options: dict[str, Any] = Field(default={})
    duration: float | None = Field(default=None, gt=0)
    start: str | dict[str, list[float]] | None = None

    @model_validator(mode="after")
    def _measures_something(self) -> Self:
        if not any(getattr(self, kind) is not None for kind in MEASUREMENTS):
            raise fault(": measures nothing", allowed=f"must have {' or '.join(MEASUREMENTS)}")
        return self

    @property
    def channels(self) -> dict[str, ChannelData]:
        """Channels of all files by name."""
        of_kinds = (x.channels for x in (self.time_series, self.static_curve) if x is not None)
        return {name: channel for channels in of_kinds for name, channel in channels.items()}


class Identify(Section):
    """Arguments of torchmbd.identification.identify.

    unknowns         unknowns with bounds and a unit
    experiments      name -> what was measured
    validation       experiments that are held out: the fitted model is compared with them
    max_evaluations  simulated designs of each start at most
    max_time         limit of time [s]; what is done by then is the result
    """

    unknowns: Annotated[dict[str, Unknown], Len(min_length=1), AfterValidator(units_fit)]
    experiments: Annotated[dict[str, ExperimentData], Len(min_length=1)]
    validation: dict[str, ExperimentData] = Field(default={})
    loss: Annotated[str, NameOf(LOSSES)] = "linear"
    f_scale: float = Field(default=1.0, gt=0)
    tolerance: float = Field(default=TOLERANCE, ge=1e-15, le=0.1)
    max_evaluations: PositiveInt = 50
    max_time: float | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _different_names(self) -> Self:
        if twice := [name for name in self.validation if name in self.experiments]:
            raise fault(
                f"= {twice[0]!r}", "validation", twice[0], allowed="must have another name than the experiments"
            )
        return self


class IdentificationFile(Section):
    """An experiment file that fits a model to measurements.

    model       the function that returns the System: path/to/file.py:function or package.module:function
    options     arguments of the model's function
    parameters  parameters of the model with other values, or the file that has them
    simulate    the motion: steps, start, method
    identify    unknowns, and what was measured
    links       entries of `unknowns` that follow others: entry -> {entry: factor, constant: offset}
    starts      values of the unknowns from which the fit starts
    tracking    where MLflow keeps the runs
    """

    model: Annotated[str, Field(pattern=FUNCTION)]
    options: dict[str, Any] = Field(default={})
    parameters: Settings = Field(default={})
    simulate: Motion = Motion()
    identify: Identify
    links: dict[str, Annotated[dict[str, float], Len(min_length=1)]] = Field(default={})
    starts: Starts = Starts()
    tracking: Tracking = Tracking()

    def resolved(self) -> dict[str, Any]:
        """Return the file with every default filled in, in the form of the file."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        if not self.parameters:
            del data["parameters"]
        for group in (data["identify"]["experiments"], data["identify"]["validation"]):
            for experiment in group.values():
                for kind in experiment.keys() & {"time_series", "static_curve"}:
                    channels = experiment[kind]["channels"]
                    for name, channel in channels.items():
                        channels[name] = channel.pop("response") | channel
        return data
