"""Faults of an experiment file that a constructor refuses: each section is constructed by itself, so that all are told at once.

The constructors know what is allowed; here their InputErrors take the path of the file. It is asked for files that have faults.
Checked in tests/contracts/test_file_mistakes.py, tests/study/file/test_load.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from torchmbd.design.problem_parts import require_duration
from torchmbd.design.response_spec import leaf, measure_of, terms
from torchmbd.design.scenario_settings import settings_of
from torchmbd.design.space import CONSTANT, DesignSpace
from torchmbd.errors import InputError, Path
from torchmbd.integrate.arguments import check_backend, check_gradients, checked_integrator
from torchmbd.integrate.registry import integrator_of
from torchmbd.integrate.variables import entry_labels
from torchmbd.math import units
from torchmbd.multibody.system import System
from torchmbd.simulation import Simulation
from torchmbd.study.file import schema
from torchmbd.study.file.assemble import in_si, links_in_si, point_in_si, sweep_in_si
from torchmbd.study.file.faults import Fault, Lines, shown
from torchmbd.study.file.model import (
    build_model,
    find_model,
    find_phases,
    find_response,
    option_faults,
)
from torchmbd.study.file.parameter_values import set_parameters
from torchmbd.study.file.scenario_keys import Scenario
from torchmbd.study.file.schema import OBJECTIVE_KEYS, Motion, Variable
from torchmbd.study.settings import check_options, sweep_values

Sections = Mapping[str, Any]
#: Keys of a design variable that have numbers.
_OF_NUMBERS = ("lower", "upper", "start", "tolerance", "step")
#: Arguments of a study's constructors that a file has under another key.
_KEYS: dict[str | int, Path] = {
    "objective": ("combine", "objective"),
    "constraints": ("combine", "constraints"),
    "weights": ("scenarios",),
    "kind": ("robust",),
    "tolerance": ("design",),
    "increments": ("design",),
    "problem": ("subject_to",),
}


class Faults(list[Fault]):
    """Faults of a file; `at` adds those of the constructors that are called in its block."""

    def __init__(self, lines: Lines) -> None:
        super().__init__()
        self.lines = lines

    @contextmanager
    def at(self, *path: str | int) -> Iterator[None]:
        """An InputError becomes a fault at the key of its argument, below a path or beside it; else at the path."""
        try:
            yield
        except InputError as error:
            whole = error.path[:1] == path[:1]  # the error has the whole path, as of an entry of links
            owners = [path[:k] for k in range(len(path), -whole, -1)]
            fault = fault_at(error, path, owners, self.lines)
            self += [fault] * (fault not in self)

    def made(self, path: Path, make: Callable[[], Any]) -> Any:
        """Return what `make` returns; None where it raises an InputError, which becomes a fault."""
        with self.at(*path):
            return make()
        return None


def fault_at(error: InputError, path: Path, owners: Iterable[Path], lines: Lines) -> Fault:
    """Return the fault of an error at the key of its argument, at `path` if the file has none.

    owners  paths of mappings that may have the key, the most likely first
    """
    for size in range(len(error.path), 0, -1):
        for place in ((*owner, *error.path[:size]) for owner in owners):
            if place in lines:
                return Fault(place, error.reason if size == len(error.path) else f": {error}")
    return Fault(path, f": {error}" if error.path else error.reason)  # without a path it is about what is there


def study_fault(error: InputError, sections: Sections, lines: Lines) -> Fault:
    """Return the fault of an error that the study as a whole raises, at the key of its argument."""
    name, *rest = error.path or ("",)
    if name in (*_OF_NUMBERS, "increments") and rest:
        entry = str(rest[0])
        variable = entry if entry in sections["design"] else entry.rpartition("[")[0]
        return _design_fault(error, variable, sections["design"][variable])
    if name == "minimize" and rest:
        return Fault(("tradeoff", rest[0]), f": {error}")
    if name in _KEYS:
        return Fault(_KEYS[name], f": {error}")
    return fault_at(error, (), [(), ("simulate",), ("optimizer",)], lines)


def built_system(sections: Sections, folder: FilePath) -> tuple[System | None, list[Fault]]:
    """Return the system of the model, None if it cannot be built, and the faults of model and options."""
    if "model" not in sections:
        return None, []
    try:
        builder = find_model(sections["model"], folder)
    except InputError as error:
        return None, [Fault(("model",), error.reason)]
    if "options" not in sections or (faults := option_faults(builder, sections["options"])):
        return None, faults if "options" in sections else []
    try:
        system = build_model(builder, sections["options"])
    except InputError as error:
        key = "options" if sections["options"] else "model"
        return None, [Fault((key,), f"= {shown(sections[key])}: {error}")]
    faults = []
    for name, x in sections.get("parameters", {}).items():
        try:
            set_parameters(system, {name: x})
        except InputError as error:
            faults.append(Fault(("parameters", name), f": {error}"))
    return system, faults


def motion_faults(motion: Motion, lines: Lines) -> list[Fault]:
    """Return what is wrong with the method of a motion, its options and its backend."""
    faults = Faults(lines)
    for name, x in motion.options.items():
        with faults.at("simulate", name):
            integrator_of(motion.method, {name: x}, type(motion).model_fields)
    with faults.at("simulate", "backend"):
        check_backend(motion.backend)
    return faults


def section_faults(sections: Sections, system: System | None, folder: FilePath, lines: Lines) -> list[Fault]:
    """Return what the constructors refuse in the valid sections and entries of a file, see validation.py.

    system  of its model, None if there is none
    """
    simulate: schema.Simulation | None = sections.get("simulate")
    faults, integrator = Faults(lines), None
    if simulate is not None:
        faults += motion_faults(simulate, lines)
        with faults.at("simulate"):
            integrator = checked_integrator(simulate.duration, simulate.method, simulate.steps, {})
            check_gradients(simulate.gradients, integrator)
    if (optimizer := sections.get("optimizer")) is not None:
        for name, x in optimizer.options.items():
            with faults.at("optimizer", name):
                check_options(optimizer.name, {name: x}, sections.get("tradeoff") is not None)
    if system is None:
        return faults
    if simulate is not None:
        with faults.at("simulate", "start"):
            Simulation(system, duration=1.0, start=simulate.start)
        if simulate.phases is not None and integrator is not None:  # their times are compared with the duration
            with faults.at("simulate", "phases"):
                Simulation(system, simulate.duration, phases=find_phases(simulate.phases, folder))
    _add_responses(faults, sections, system, folder)
    if "design" in sections:
        _add_design(faults, sections, system)
    _add_scenarios(faults, sections, system, folder)
    return faults


def _add_responses(faults: Faults, sections: Sections, system: System, folder: FilePath) -> None:
    specs: list[tuple[Mapping[str, Any], Path]] = [
        (sections[key], (key,)) for key in OBJECTIVE_KEYS[:-1] if sections.get(key) is not None
    ]
    specs += [(x, ("tradeoff", name)) for name, x in (sections.get("tradeoff") or {}).items() if x is not None]
    specs += [(x.measure, ("subject_to", k)) for k, x in enumerate(sections.get("subject_to") or ()) if x is not None]
    read = partial(measure_of, find=partial(find_response, folder=folder))
    for part, place in (operand for spec, path in specs for operand in terms(spec, path)):
        with faults.at(*place):
            measure = read(part)
            with faults.at(*leaf(part, place)):
                measure.check(system)
            if "simulate" in sections:
                require_duration(measure, sections["simulate"].duration)


def _add_design(faults: Faults, sections: Sections, system: System) -> None:
    """Add the faults of design variables, links, start points and a sweep.

    Numbers of a variable are checked whatever is wrong with others: which entries have some depends on what follows, not
    on what it follows. A link, a start point and a sweep are checked where all variables are known that they may name.
    """
    design: Mapping[str, Variable | None] = sections["design"]
    known: dict[str, Variable] = {}
    for name, variable in design.items():
        with faults.at("design", name):
            DesignSpace(system, [name])
            if variable is not None and (text := units.misfit(name, variable.unit)):
                faults.append(Fault(("design", name, "unit"), f"= {variable.unit!r}: {text}"))
            elif variable is not None:
                known[name] = variable
    if "links" not in sections or not known:
        return
    links, entries = sections["links"], list(entry_labels(system, list(known)))
    followers = {entry: {CONSTANT: 0.0} for entry in links if entry in entries}
    if len(followers) == len(entries) and len(known) < len(design):
        return
    space = partial(DesignSpace, system, list(known))
    unlinked = None
    with faults.at("links"):
        unlinked = space(links=followers)
    if unlinked is None:
        return
    unknown = design.keys() - known.keys()
    for follower, leaders in links_in_si(known, {key: x for key, x in links.items() if x is not None}).items():
        for leader, factor in leaders.items():
            if unknown.isdisjoint(entry.rpartition("[")[0] for entry in (follower, leader)):
                with faults.at("links", follower):
                    space(links=followers | {follower: {leader: factor}})
    make, valid = partial(space, links=followers), {}
    for name, variable in known.items():
        of_numbers = _number_faults(name, variable, make, unlinked)
        faults += of_numbers
        if not of_numbers:
            valid[name] = variable
    if not unknown:
        whole = make(bounds=(in_si(valid, "lower"), in_si(valid, "upper")), start=in_si(valid, "start"))
        _add_points(faults, sections, whole)


def _number_faults(name: str, variable: Variable, make: Callable[..., DesignSpace], space: DesignSpace) -> list[Fault]:
    """Return the faults of the numbers of a design variable; `make`: its space, with bounds and start; `space`: without."""
    alone, zeros, of_keys = {name: variable}, np.zeros(len(space.names)), []
    for key in _OF_NUMBERS:
        of_keys += _faults_of(name, variable, partial(space.vector, key, in_si(alone, key), zeros))
    if not of_keys:
        start, lower, upper = (in_si(alone, key) for key in ("start", "lower", "upper"))
        pairs = {name: (lower.get(name, -np.inf), upper.get(name, np.inf))} if lower or upper else {}
        of_keys = _faults_of(name, variable, partial(make, bounds=pairs, start=start))
    missing = [key for key in ("lower", "upper") if getattr(variable, key) is None]
    if len(missing) == 2 and all(entry.rpartition("[")[0] != name for entry in space.names):
        missing = []  # every entry follows others
    return [Fault(("design", name, key), "is missing: must be a number") for key in missing] + of_keys


def _faults_of(name: str, variable: Variable, construct: Callable[[], Any]) -> list[Fault]:
    """Return the fault of a design variable that a constructor refuses, none if it accepts it."""
    try:
        construct()
    except InputError as error:
        return [_design_fault(error, name, variable)]
    return []


def _design_fault(error: InputError, name: str, variable: Variable) -> Fault:
    """Return the fault of an error about the numbers of a design variable, at its key and with its value there.

    ("start", "rod.laminate.angles[1]") is the key design.rod.laminate.angles.start
    """
    key, entry, *indices = (*error.path, "", "")[: max(len(error.path), 2)]
    key = "step" if key == "increments" else str(key)
    if key not in _OF_NUMBERS:
        return Fault(("design", name), f": {error}")
    value = getattr(variable, key)
    text = "is not given, and the model is built with" if value is None else f"= {value}"
    if error.hint:  # an angle of more than a turn
        text, error.hint = f"= {value} with unit: {variable.unit}", "unit: deg"
    index = f"{str(entry).removeprefix(name)}{''.join(f'[{k}]' for k in indices)} ".lstrip()
    joint = ":" if value is not None and (index or not error.state) else ""
    return Fault(("design", name, key), f"{text}{joint} {index}{error.reason}")


def _add_points(faults: Faults, sections: Sections, space: DesignSpace) -> None:
    """Add the faults of start points and of a sweep, in a space of all variables."""
    design, starts, sweep = sections["design"], sections.get("starts"), sections.get("sweep")
    for k, point in enumerate(() if starts is None else starts.points or ()):
        try:
            space.point("start", point_in_si(design, space.names, point), np.zeros(len(space.names)))
        except InputError as error:
            entry = f": {error.path[1]} " if len(error.path) > 1 else " "
            faults.append(Fault(("starts", "points", k), f"= {point}{entry}{error.reason}"))
    for name, span in sweep_in_si(design, sweep or {}).items():
        with faults.at("sweep", name):
            sweep_values(name, span, space.names, space.lower, space.upper)


def _add_scenarios(faults: Faults, sections: Sections, system: System, folder: FilePath) -> None:
    """Add the faults of scenarios: options that cannot be built, parameters that they cannot set."""
    scenarios: Sequence[Scenario | None] = sections.get("scenarios") or ()
    for k, scenario in enumerate(scenarios):
        if scenario is None:
            continue
        variant, path, before = system, ("scenarios", k), len(faults)
        options = {**sections["options"], **scenario.options}
        builder = find_model(sections["model"], folder)
        faults += [Fault((*path, *fault.path), fault.text) for fault in option_faults(builder, options)]
        if scenario.options and len(faults) == before:
            try:
                variant = set_parameters(build_model(builder, options), sections.get("parameters", {}))
            except InputError as error:
                faults.append(Fault((*path, "options"), f"= {shown(scenario.options)}: {error}"))
        for name, x in scenario.settings.items():
            try:
                settings_of(variant, list(sections.get("design", ())), f"in scenario {str(k)!r}", {name: x})
            except InputError as error:
                if error.hint:  # there is no such parameter
                    error.hint += ", or options: {...} of the scenario for arguments of the model"
                faults.append(Fault((*path, "set", name), error.reason))
