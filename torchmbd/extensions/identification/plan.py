"""Make an identification from a valid experiment file: experiments, unknowns, starts; and the faults of one that is not.

Names of unknowns are those of `identify`: a parameter of the model, or a number of the sensor of a channel. Such a number is
made a variable where its name is among the unknowns, or where the channel names an unknown in its place.
Checked in tests/extensions/identification/test_files.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.design.response_spec import history_of
from torchmbd.design.scenario_settings import MAKE_PARAMETER
from torchmbd.design.words import unit as unit_of
from torchmbd.errors import InputError, must_be_one
from torchmbd.errors import Path as FaultPath
from torchmbd.extensions.identification.channel import SENSOR, Channel
from torchmbd.extensions.identification.experiment import Experiment
from torchmbd.extensions.identification.fit_problem import FitProblem
from torchmbd.extensions.identification.frequency_response_data import FrequencyResponseData
from torchmbd.extensions.identification.modal_data import ModalData
from torchmbd.extensions.identification.registry import MEASUREMENTS
from torchmbd.extensions.identification.sections import (
    ChannelData,
    ExperimentData,
    IdentificationFile,
    PortKeys,
    Unknown,
)
from torchmbd.extensions.identification.static_curve import StaticCurve
from torchmbd.extensions.identification.stored_fit import fit_key
from torchmbd.extensions.identification.time_series import TimeSeries
from torchmbd.extensions.vibrations.ports_by_name import NamedPort
from torchmbd.math import units
from torchmbd.math.variable import variable
from torchmbd.multibody.system import System
from torchmbd.study.file.assemble import in_si, links_in_si, starts_of
from torchmbd.study.file.check import Faults, built_system, motion_faults
from torchmbd.study.file.faults import Fault
from torchmbd.study.file.kind import FilePlan, Source
from torchmbd.study.file.model import build_model, find_model, find_phases, find_response, option_faults
from torchmbd.study.file.parameter_values import set_parameters
from torchmbd.study.file.scenario_keys import si_of
from torchmbd.study.file.schema import UNITS, Motion
from torchmbd.study.record.paths import file_key, numbers_key
from torchmbd.tracking.uri import StoreURI

_SENSOR_UNITS = {"delay": "s", "gain": ""}  # of an offset: that of the response
_DEFAULTS = {"delay": 0.0, "gain": 1.0, "offset": 0.0}


@dataclass(frozen=True, eq=False)
class IdentificationPlan(FilePlan):
    """An experiment file that fits a model to measurements, and what is made of it.

    problem              the residuals as a function of the unknowns
    experiments, validation   by name;  arguments: further ones of `identify`
    """

    data: IdentificationFile
    experiments: Mapping[str, Experiment]
    validation: Mapping[str, Experiment]
    arguments: Mapping[str, Any]
    problem: FitProblem

    @property
    def kind(self) -> str:
        return "identification"

    def key(self, store: StoreURI | str) -> str:
        """The hash of the file with the numbers of its measurements and models, and its store."""
        problems = [self.problem, *([self.problem.held_out(self.validation)] if self.validation else [])]
        return file_key([self.resolved(), [numbers_key(fit_key(x)) for x in problems]], self.name, store)

    def unit(self, entry: str) -> str:
        """The unit of an unknown, `hinge.damping[0]`, in the file."""
        return self.data.identify.unknowns[entry.rpartition("[")[0] or entry].unit

    def factor(self, entry: str) -> float:
        """The factor from this unit to SI."""
        return UNITS[self.unit(entry)]


@dataclass
class _Maker:
    """Makes the experiments of a file, and keeps what is wrong with them."""

    data: IdentificationFile
    system: System
    folder: Path
    faults: Faults
    sensors: dict[str, Any] = field(default_factory=dict)  # unknowns of sensors by name -> variables
    systems: dict[str, System] = field(default_factory=dict)

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        return self.data.identify.unknowns

    @property
    def parameters(self) -> list[str]:
        """Names of parameters of all systems."""
        names = [name for system in (self.system, *self.systems.values()) for name, _ in system.named_parameters()]
        return list(dict.fromkeys(names))

    @property
    def sensor_labels(self) -> list[str]:
        """Names of delays, gains and offsets of all channels of experiments."""
        experiments = self.data.identify.experiments
        return [
            f"{name}.{channel}.{key}" if len(experiments) > 1 else f"{channel}.{key}"
            for name, x in experiments.items()
            for channel in x.channels
            for key in SENSOR
        ]

    def experiment(self, kind: str, name: str, data: ExperimentData) -> Experiment | None:
        """The experiment, or None with its faults."""
        path = ("identify", kind, name)
        system = self._system((*path, "options"), data.options)
        makers = {
            "modal_data": lambda: self._modal_data(path, data.modal_data),
            "frequency_responses": lambda: self._frequency_responses(path, data.frequency_responses, system),
        }
        made = [
            makers[key]() if key in makers else self._of_file(path, kind, name, key, system)
            for key in MEASUREMENTS
            if getattr(data, key) is not None
        ]
        measured = [x for x in made if x is not None]
        if system is None or len(measured) < len(made):
            return None
        simulate: Motion = self.data.simulate
        start = simulate.start if data.start is None else data.start
        phases = None
        if simulate.phases is not None:
            phases = self.faults.made(("simulate", "phases"), partial(find_phases, simulate.phases, self.folder))
        options = {"method": simulate.method, "phases": phases, "backend": simulate.backend, "start": start}
        make = partial(Experiment, system, measured, si_of(data.set), data.duration, simulate.steps)
        return self.faults.made(path, partial(make, **options, **simulate.options))

    def _of_file(
        self, path: FaultPath, kind: str, name: str, key: str, system: System | None
    ) -> TimeSeries | StaticCurve | None:
        """The measurement `key` of an experiment, in a file; None with its faults, those of a channel at the channel."""
        data: Any = getattr(getattr(self.data.identify, kind)[name], key)
        channels: dict[str, Channel] = {}
        for channel, x in data.channels.items():
            place = (*path, key, "channels", channel)
            made = self._channel(place, kind, name, channel, x)
            if made is not None and system is not None:
                before = len(self.faults)
                self.faults.made(place, partial(made.response.check, system))
                channels |= {channel: made} if len(self.faults) == before else {}
        if not channels:
            return None
        file = self.folder / data.file
        try:
            series = key == "time_series"
            made = TimeSeries(file, channels, data.time) if series else StaticCurve(file, data.loads, channels)
            if system is not None and len(channels) == len(data.channels):
                made.check(system)
                return made
            return None
        except InputError as error:
            where, text = _place_in_table(error, data, channels), str(error)
        except OSError as error:
            where, text = ("file",), f"cannot be read: {error.strerror}"
        self.faults.append(Fault((*path, key, *where), f": {text}"))
        return None

    def _modal_data(self, path: FaultPath, data: Any) -> ModalData | None:
        place = (*path, "modal_data")
        find = partial(find_response, folder=self.folder)
        sensors = [
            self.faults.made((*place, "sensors", k), partial(history_of, x, (), find))
            for k, x in enumerate(data.sensors)
        ]
        if None in sensors:
            return None
        damping = None if data.damping is None else [np.nan if x is None else x for x in data.damping]
        shares = {key: getattr(data, key) for key in ("frequency_share", "damping_share")}
        shares |= {} if data.least_mac is None else {"least_mac": data.least_mac}
        make = partial(ModalData, data.frequencies, damping, data.shapes, sensors, data.modes, **shares)
        return self.faults.made(place, make)

    def _frequency_responses(self, path: FaultPath, data: Any, system: System | None) -> FrequencyResponseData | None:
        if system is None:
            return None
        place = (*path, "frequency_responses")

        def port(x: PortKeys) -> NamedPort:
            return NamedPort(x.name, x.direction, x.place)

        def output(x: PortKeys) -> Any:
            signal, row = port(x).output(system)
            return signal if signal.size == 1 else (signal, "xyz"[row])

        source = self.faults.made((*place, "input"), lambda: port(data.input).input(system))
        outputs = {
            name: self.faults.made((*place, "outputs", name), partial(output, x)) for name, x in data.outputs.items()
        }
        if source is None or None in outputs.values():
            return None
        keys = {key: getattr(data, key) for key in ("frequency", "quantity", "form", "deviation")}
        spin = {} if data.spin is None else {"spin": data.spin}
        make = partial(FrequencyResponseData, self.folder / data.file, source, outputs, **keys, **spin)
        try:
            return self.faults.made(place, make)
        except OSError as error:
            self.faults.append(Fault((*place, "file"), f": cannot be read: {error.strerror}"))
            return None

    def _system(self, path: FaultPath, options: Mapping[str, Any]) -> System | None:
        if not options:
            return self.system
        builder, merged = find_model(self.data.model, self.folder), {**self.data.options, **options}
        if faults := option_faults(builder, merged):
            self.faults += [Fault((*path, *fault.path[1:]), fault.text) for fault in faults]
            return None
        key = repr(sorted(merged.items()))
        if key not in self.systems:
            make = partial(build_model, builder, merged)
            built = self.faults.made(path, lambda: set_parameters(make(), self.data.parameters))
            if built is None:
                return None
            self.systems[key] = built
        return self.systems[key]

    def _channel(self, path: FaultPath, kind: str, name: str, channel: str, data: ChannelData) -> Channel | None:
        response = self.faults.made(
            path, partial(history_of, data.response, (), partial(find_response, folder=self.folder))
        )
        if response is None:
            return None
        scale, si = 1.0 if data.unit is None else UNITS[data.unit], unit_of(response)
        several = len(self.data.identify.experiments) > 1
        numbers: dict[str, Any] = {}
        for key in SENSOR:
            label = f"{name}.{channel}.{key}" if several else f"{channel}.{key}"
            written = getattr(data, key)
            label = written if isinstance(written, str) else label
            factor = scale if key == "offset" else 1.0
            if isinstance(written, str) and written not in self.sensor_labels:
                self.faults.append(
                    Fault((*path, key), f"= {written!r} is not a sensor: {must_be_one(written, self.sensor_labels)}")
                )
                return None
            if label in self.unknowns and (kind == "experiments" or isinstance(written, str)):
                first = _DEFAULTS[key] if isinstance(written, str) else factor * written
                numbers[key] = self._sensor(label, key, first, si)
            elif isinstance(written, str):
                text = f"= {written!r} is not an unknown: {must_be_one(written, self.unknowns)}"
                self.faults.append(Fault((*path, key), text))
                return None
            else:
                numbers[key] = factor * written
        deviation = None if data.deviation is None else scale * data.deviation
        return self.faults.made(path, partial(Channel, response, data.column, data.unit, deviation, **numbers))

    def _sensor(self, label: str, key: str, first: float, si: str | None) -> Any:
        if label not in self.sensors:
            unknown = self.unknowns[label]
            expected = _SENSOR_UNITS.get(key, si)
            if unknown.unit != units.NONE and expected is not None and units.UNITS[unknown.unit][1] != expected:
                allowed = ", ".join(units.units_of(expected)) or units.NONE
                self.faults.append(
                    Fault(("identify", "unknowns", label, "unit"), f"= {unknown.unit!r}: must be {allowed}")
                )
            start = unknown.start
            self.sensors[label] = variable(
                first if start is None or isinstance(start, list) else UNITS[unknown.unit] * start
            )
        return self.sensors[label]


def read_identification(
    source: Source, sections: dict[str, Any], faults: list[Fault]
) -> IdentificationPlan | list[Fault]:
    """The identification of a file, or all faults; its experiments are checked where its keys and its model are valid."""
    system, of_model = built_system(sections, source.folder)
    faults = faults + of_model
    if "simulate" in sections:
        faults += motion_faults(sections["simulate"], source.document.lines)
    if system is None or faults:
        return faults
    data = IdentificationFile.model_construct(**sections)
    maker = _Maker(data, system, source.folder, Faults(source.document.lines))
    identify, faults = data.identify, maker.faults
    experiments = {name: maker.experiment("experiments", name, x) for name, x in identify.experiments.items()}
    held_out = {name: maker.experiment("validation", name, x) for name, x in identify.validation.items()}
    parameters = maker.parameters
    names = [name for name in identify.unknowns if name not in maker.sensors]
    for name in names:
        if name not in parameters:
            text = must_be_one(name, [*parameters, *maker.sensor_labels], MAKE_PARAMETER)
            faults.append(
                Fault(
                    ("identify", "unknowns", name), f"is not a parameter of the model or a number of a sensor: {text}"
                )
            )
    if faults:
        return faults
    made = {name: x for name, x in experiments.items() if x is not None}
    others = {name: x for name, x in held_out.items() if x is not None}
    unknowns = identify.unknowns
    lower, upper = in_si(unknowns, "lower"), in_si(unknowns, "upper")
    prior = {name: x.prior for name, x in unknowns.items() if x.prior is not None}
    factors = {name: UNITS[x.unit] for name, x in unknowns.items()}
    arguments = {
        "bounds": {name: (lower.get(name, -np.inf), upper.get(name, np.inf)) for name in unknowns},
        "start": in_si(unknowns, "start"),
        "links": links_in_si(unknowns, data.links),
        "priors": {
            n: (factors[n] * np.asarray(p.mean), factors[n] * np.asarray(p.deviation)) for n, p in prior.items()
        },
    }
    # Unknowns of sensors have the names that their channels have; these are the names of the file.
    problem = None
    try:
        problem = FitProblem(made, names, **arguments)
        scales = in_si(unknowns, "scale")
        problem.space.vector("scale", scales, np.ones(len(problem.names)))
        if others:
            problem.held_out(others)
    except InputError as error:
        return [Fault(_place(error, unknowns), f": {error}")]
    more = {
        "unknowns": names,
        "scales": scales or None,
        "loss": identify.loss,
        "f_scale": identify.f_scale,
        "tolerance": identify.tolerance,
        "max_evaluations": identify.max_evaluations,
        "max_time": identify.max_time,
        "starts": starts_of(data.starts, unknowns, problem.names, problem.start),
    }
    return IdentificationPlan(data, source, made, others, arguments | more, problem)


def _place(error: InputError, unknowns: Mapping[str, Unknown]) -> FaultPath:
    """The path of an error about unknowns: at the unknown, and at the key of it that the file has."""
    key, entry, *_ = (*error.path, "", "")
    entry = str(entry).partition("[")[0] if entry not in unknowns else str(entry)
    if entry not in unknowns:
        return ("identify",)
    has_key = key in ("lower", "upper", "prior", "scale", "start") and getattr(unknowns[entry], str(key)) is not None
    return ("identify", "unknowns", entry, *([key] if has_key else []))


def _place_in_table(error: InputError, data: Any, channels: Mapping[str, Channel]) -> FaultPath:
    """The path below a measurement of an error about its file: at the channel, the time or the load that has the column."""
    kind, name, *_ = (*error.path, "", "")
    if kind == "columns":
        columns = {channel: x.column or channel for channel, x in channels.items()}
        places = [("channels", channel) for channel, column in columns.items() if column == name]
        places += [("time",)] * (name == getattr(data, "time", None))
        places += [("loads", load) for load, column in getattr(data, "loads", {}).items() if column == name]
        return places[0] if places else ("file",)
    return (kind, name)[: 1 + (kind != "time")] if kind in ("channels", "loads", "time") else ("file",)
