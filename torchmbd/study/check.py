"""Faults of an experiment file that only its model shows: names and sizes of options, parameters, bodies and responses.

Only valid sections are checked, so that a fault of one section does not hide those of the others.
Over 300 lines: a short function for each section of the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch

from torchmbd.design.response import Measure
from torchmbd.design.response_spec import SpecError, leaf, measure_of, terms
from torchmbd.design.space import CONSTANT
from torchmbd.errors import InputError, nearest
from torchmbd.integrate.arguments import is_positive, start_of
from torchmbd.integrate.memory import require_memory
from torchmbd.integrate.segment import segments_of
from torchmbd.math import units
from torchmbd.math.plausible_units import check_angles, check_parameter, turn_in_radians
from torchmbd.multibody.system import System
from torchmbd.study.file_errors import Fault, Path, shown
from torchmbd.study.method_options import method_faults
from torchmbd.study.model import (
    build_model,
    find_function,
    find_model,
    find_phases,
    find_response,
    option_faults,
    require_returns,
    scenario_systems,
)
from torchmbd.study.scenario_keys import Combine, Scenario, Setting
from torchmbd.study.schema import OBJECTIVE_KEYS, UNITS, Range, Simulation, Starts, Variable

Sections = Mapping[str, Any]
_NUMBERS = ("start", "lower", "upper", "tolerance", "step")  # of a design variable


def check(sections: Sections, folder: FilePath) -> tuple[System | None, list[Fault]]:
    """Return the system, None if it cannot be built, and the faults of the valid sections of a file."""
    faults = method_faults(sections)
    if "model" not in sections:
        return None, faults
    try:
        builder = find_model(sections["model"], folder)
    except InputError as error:
        return None, [*faults, Fault(("model",), str(error))]
    if "options" not in sections or (wrong := option_faults(builder, sections["options"])):
        return None, faults + (wrong if "options" in sections else [])
    try:
        system = build_model(builder, sections["options"])
    except InputError as error:
        return None, [*faults, Fault(("options",), f"= {shown(sections['options'])}: {error}")]
    faults += _phase_faults(sections, folder, system) + _response_faults(sections, folder, system)
    if "design" in sections:
        faults += _link_faults(sections, system) + _design_faults(sections["design"], system, sections.get("links", {}))
        if not faults:
            faults += _start_faults(sections, system) + _memory_faults(sections, system)
    faults += _motion_start_faults(sections, system) + _scenario_faults(sections, folder, system)
    return system, faults


def figure_faults(sections: Sections, folder: FilePath) -> list[Fault]:
    """Return the faults of the function that draws figures, and of its options."""
    if "figures" not in sections:
        return []
    try:
        draw = find_function(sections["figures"], folder)
        require_returns(sections["figures"], draw, ("dict", "Mapping"))
    except InputError as error:
        return [Fault(("figures",), str(error))]
    taken = {"folder": None, **sections.get("options", {})}
    faults = [Fault(("options", "folder"), "is given by torchmbd")] if "folder" in sections.get("options", {}) else []
    return faults + option_faults(draw, taken)


def spread(given: float | Sequence[float], size: int) -> np.ndarray | None:
    """Return a number repeated `size` times, or a list as an array; None if the list has another length."""
    x = np.atleast_1d(np.asarray(given, dtype=float))
    return np.full(size, x[0]) if not isinstance(given, (list, tuple)) else x if len(x) == size else None


def design_vector(design: Mapping[str, Variable], system: System, key: str, links: Collection[str] = ()) -> np.ndarray:
    """Return "start", "lower", "upper", "tolerance" or "step" of the whole design vector, in the units of the file."""
    parameters = dict(system.named_parameters())
    parts = []
    for name, variable in design.items():
        given, free = getattr(variable, key), _free_entries(name, parameters[name].numel(), links)
        if given is None and key in ("tolerance", "step"):
            parts.append(np.zeros(len(free)))
        elif given is None:  # the start is that of the model
            parts.append(parameters[name].detach().reshape(-1).numpy()[free] / UNITS[variable.unit])
        else:
            parts.append(spread(given, len(free)))
    return np.concatenate(parts)


def entry_labels(design: Mapping[str, Variable], system: System, links: Collection[str] = ()) -> list[str]:
    """Return the label of each entry of the design vector, `rod.laminate.angles[0]`; entries that follow others are none."""
    parameters = dict(system.named_parameters())
    return [f"{name}[{i}]" for name in design for i in _free_entries(name, parameters[name].numel(), links)]


def _free_entries(name: str, size: int, links: Collection[str]) -> list[int]:
    """Return the indices of the entries of a parameter that follow no others."""
    return [i for i in range(size) if f"{name}[{i}]" not in links]


def _phase_faults(sections: Sections, folder: FilePath, system: System) -> list[Fault]:
    """Return the faults of the function of the phases, and of the phases for the model."""
    simulation: Simulation | None = sections.get("simulate")
    if simulation is None or simulation.phases is None:
        return []
    try:
        segments_of(system, find_phases(simulation.phases, folder), simulation.duration)
    except InputError as error:
        return [Fault(("simulate", "phases"), str(error))]
    return []


def _response_faults(sections: Sections, folder: FilePath, system: System) -> list[Fault]:
    """Return the faults of the responses: names that the model has not, windows beyond the simulated time, rows."""
    duration = sections["simulate"].duration if "simulate" in sections else math.inf
    given: list[tuple[Mapping[str, Any], Path]] = []
    read = partial(measure_of, find=partial(find_response, folder=folder))
    for key in OBJECTIVE_KEYS[:-1]:
        if sections.get(key) is not None:
            given.append((sections[key], (key,)))
    given += [(spec, ("tradeoff", name)) for name, spec in (sections.get("tradeoff") or {}).items()]
    given += [(c.measure, ("subject_to", k)) for k, c in enumerate(sections.get("subject_to") or ())]
    faults = []
    for spec, path in given:
        for part, place in terms(spec, path):
            try:
                measure = read(part)
                measure.check(system)
            except SpecError as error:
                faults.append(Fault((*place, *error.path), error.text))
                continue
            except InputError as error:
                faults.append(Fault(leaf(part, place), f": {error}"))
                continue
            if measure.until > duration * (1.0 + 1e-9):
                text = f"looks at t = {measure.until:g} s; allowed: up to simulate.duration = {duration:g}"
                faults.append(Fault(place, text))
    return faults or _row_faults(sections, read)


def _row_faults(sections: Sections, read: Callable[..., Measure]) -> list[Fault]:
    """Return the faults of objectives of several rows, where one number is allowed."""
    for key in OBJECTIVE_KEYS[:-1]:
        if sections.get(key) is not None and sections.get("sweep") and read(sections[key]).rows > 1:
            text = "has several rows; allowed in a sweep: one number, such as max: {strain_energy: rod}"
            return [Fault(leaf(sections[key], (key,))[:2], text)]
    if sections.get("maximize") is not None and (text := _maximize_fault(sections, read(sections["maximize"]).rows)):
        return [Fault(("maximize",), text)]
    rows = {name: read(spec).rows for name, spec in (sections.get("tradeoff") or {}).items()}
    text = "has {} rows; allowed: responses of one number"
    return [Fault(("tradeoff", name), text.format(n)) for name, n in rows.items() if n > 1]


def _maximize_fault(sections: Sections, rows: int) -> str | None:
    """Return why a response of so many rows cannot be maximized, None if it can."""
    if rows > 1:
        return f"has {rows} rows; allowed: a response of one number"
    combined: Combine | None = sections.get("combine")
    if sections.get("scenarios") and (combined or Combine()).objective == "worst":
        return "and combine.objective: worst are both given; allowed: combine.objective: mean"
    return None


def _link_faults(sections: Sections, system: System) -> list[Fault]:
    """Return the faults of links: a follower that is no entry of a design variable, a leader that is not free."""
    links: Mapping[str, Mapping[str, float]] = sections.get("links", {})
    parameters = dict(system.named_parameters())
    known = {name: x for name, x in sections["design"].items() if name in parameters}
    entries, free = entry_labels(known, system), [*entry_labels(known, system, links), CONSTANT]
    faults = []
    for follower, leaders in links.items():
        if follower not in entries:
            faults.append(Fault(("links", follower), f"is no entry of a design variable{nearest(follower, entries)}"))
        faults += [
            Fault(("links", follower, leader), f"is no entry that follows none itself{nearest(leader, free)}")
            for leader in leaders
            if leader not in free
        ]
    return faults or (
        [] if len(free) > 1 or not links else [Fault(("links",), "leave no entry free; allowed: one at least")]
    )


def _design_faults(design: Mapping[str, Variable], system: System, links: Collection[str] = ()) -> list[Fault]:
    parameters = dict(system.named_parameters())
    faults = []
    for name, variable in design.items():
        path: Path = ("design", name)
        if name not in parameters:
            faults.append(Fault(path, f"is no parameter of the model{nearest(name, parameters)}"))
            continue
        entries = _free_entries(name, parameters[name].numel(), links)
        size = len(entries)
        given_keys = [key for key in _NUMBERS if getattr(variable, key) is not None]
        if not size:
            follows = "is given, but every entry follows others by links; allowed: unit alone"
            faults += [Fault((*path, key), follows) for key in given_keys]
            continue
        faults += [
            Fault((*path, key), "is missing; allowed: a number") for key in ("lower", "upper") if key not in given_keys
        ]
        some = f" (of {', '.join(f'[{i}]' for i in entries)}; the others follow)" * (size < parameters[name].numel())
        sized = {key: spread(getattr(variable, key), size) for key in given_keys}
        for key, x in sized.items():
            if x is None:
                given = getattr(variable, key)
                faults.append(
                    Fault(
                        (*path, key),
                        f"= {given}: has {len(given)} values; allowed: {size}{some}, or one number for all",
                    )
                )
        built = parameters[name].detach().reshape(-1).numpy()[entries] / UNITS[variable.unit]
        faults += _bound_faults(path, sized, built) + _unit_faults(path, name, variable.unit, sized)
    return faults


def _unit_faults(path: Path, name: str, unit: str, sized: Mapping[str, np.ndarray | None]) -> list[Fault]:
    """Return the faults of units: one that does not fit the parameter, or numbers that are most likely in another."""
    if text := units.misfit(name, unit):
        return [Fault((*path, "unit"), f"= {unit!r}: {text}")]
    faults = []
    for key, x in sized.items():
        if x is None:
            continue
        try:
            if unit == "rad":
                check_angles(name, x.tolist())
            if unit == "deg" and key in ("lower", "upper") and (text := turn_in_radians(x.tolist())):
                faults.append(
                    Fault((*path, key), f"= {x.tolist()} with unit: deg: {text}; allowed: degrees, or unit: rad")
                )
                continue
            check_parameter(key, name, torch.from_numpy(UNITS[unit] * x))
        except InputError as error:
            hint = ", or unit: deg" if unit in ("rad", units.NONE) else ""
            faults.append(Fault((*path, key), f"= {x.tolist()} with unit: {unit}: {error}{hint}"))
    return faults


def _bound_faults(path: Path, sized: Mapping[str, np.ndarray | None], built: np.ndarray) -> list[Fault]:
    """Return the faults of bounds: not in order, or without the start (of the file, or `built` by the model)."""
    lower, upper, start = sized.get("lower"), sized.get("upper"), sized.get("start")
    if lower is None or upper is None:
        return []
    if not (lower < upper).all():
        return [Fault((*path, "lower"), f"= {lower.tolist()}: must be below upper = {upper.tolist()}")]
    between = f"must lie between {lower.tolist()} and {upper.tolist()}"
    if start is not None and not ((lower <= start) & (start <= upper)).all():
        return [Fault((*path, "start"), f"= {start.tolist()}: {between}")]
    slack = 1e-9 * (upper - lower)  # of the conversion of units
    if "start" not in sized and not ((lower - slack <= built) & (built <= upper + slack)).all():
        return [Fault((*path, "start"), f"is not given, and the model is built with {built.tolist()}, which {between}")]
    return []


def _start_faults(sections: Sections, system: System) -> list[Fault]:
    """Return the faults of start points and sweeps: wrong size, or beyond the bounds."""
    design, links = sections["design"], sections.get("links", {})
    names = entry_labels(design, system, links)
    lower, upper = (design_vector(design, system, key, links) for key in ("lower", "upper"))
    starts: Starts | None = sections.get("starts")
    faults = []
    for k, point in enumerate((starts.points if starts else None) or ()):
        if len(point) != len(names):
            text = f"= {point}: has {len(point)} values; allowed: {len(names)}, one for each of {', '.join(names)}"
            faults.append(Fault(("starts", "points", k), text))
        elif not ((lower <= point) & (point <= upper)).all():
            text = f"= {point}: must lie between {lower.tolist()} and {upper.tolist()}"
            faults.append(Fault(("starts", "points", k), text))
    sweep: Mapping[str, Range] = sections.get("sweep") or {}
    for name, span in sweep.items():
        index = swept_index(name, names)
        if index is None:
            faults.append(Fault(("sweep", name), f"names no single design variable{nearest(name, names)}"))
        elif not (lower[index] <= min(span.first, span.last) and max(span.first, span.last) <= upper[index]):
            text = f"from {span.first:g} to {span.last:g}: must lie between {lower[index]:g} and {upper[index]:g}"
            faults.append(Fault(("sweep", name), text))
    return faults


def _motion_start_faults(sections: Sections, system: System) -> list[Fault]:
    """Return the faults of the start of the motions for the model."""
    simulation: Simulation | None = sections.get("simulate")
    if simulation is None:
        return []
    try:
        start_of(system, simulation.start)
    except InputError as error:
        return [Fault(("simulate", "start"), f": {error}")]
    return []


def _scenario_faults(sections: Sections, folder: FilePath, system: System) -> list[Fault]:
    """Return the faults of scenarios: names, sizes and units of the parameters that they set, options and weights."""
    scenarios: Sequence[Scenario] = sections.get("scenarios") or ()
    design, faults = sections.get("design", {}), []
    systems: list[System | None] = [None] * len(scenarios)
    for k, scenario in enumerate(scenarios):
        path: Path = ("scenarios", k, "options")
        wrong = option_faults(find_model(sections["model"], folder), {**sections["options"], **scenario.options})
        faults += [Fault((*path[:2], *fault.path), fault.text) for fault in wrong]
        try:
            if scenario.options and not wrong:
                [systems[k]] = scenario_systems(sections["model"], sections["options"], [scenario], folder)
        except InputError as error:
            faults.append(Fault(path, f"= {shown(scenario.options)}: {error}"))
    each = ((k, n, x, s.set[n]) for k, s in enumerate(scenarios) for n, x in s.settings.items())
    for k, name, given, setting in each:
        path, parameters = ("scenarios", k, "set", name), dict((systems[k] or system).named_parameters())
        if name not in parameters:
            hint = (
                "; a plain number of the model becomes a parameter by mbd.variable(...), options: {...} of a scenario "
            )
            hint += "are other arguments of the model's function"
            faults.append(Fault(path, f"is no parameter of the model{nearest(name, parameters)}{hint}"))
        elif name in design:
            faults.append(Fault(path, "is a design variable; allowed: parameters that are none"))
        elif (x := spread(given, parameters[name].numel())) is None:
            size = f"{parameters[name].numel()}, or one number for all"
            faults.append(Fault(path, f"= {given}: has {len(np.atleast_1d(given))} values; allowed: {size}"))
        elif text := _unit_of_setting(name, setting):
            faults.append(Fault(path, text))
        elif is_positive(systems[k] or system, name) and not (x > 0.0).all():
            faults.append(Fault(path, f"= {given}: allowed: positive numbers"))
        else:
            try:
                check_parameter("scenario sets", name, torch.from_numpy(x))
            except InputError as error:
                faults.append(Fault(path, f"= {given}: {error}"))
    if scenarios and not any(scenario.weight for scenario in scenarios):
        faults.append(Fault(("scenarios",), "have weights that are all 0; allowed: one at least that is positive"))
    return faults


def _unit_of_setting(name: str, setting: Any) -> str | None:
    """Return what is wrong with the unit of a parameter that a scenario sets; an angle needs one."""
    if isinstance(setting, Setting):
        text = units.misfit(name, setting.unit)
        return text and f"= {setting.value} with unit: {setting.unit}: {text}"
    if units.QUANTITIES.get(name.rpartition(".")[2]) == "rad":
        return f"= {setting}: is an angle without a unit; allowed: {{value: {setting}, unit: deg}}, or unit: rad"
    return None


def _memory_faults(sections: Sections, system: System) -> list[Fault]:
    """Return a fault if a motion of one design does not fit into memory."""
    simulation: Simulation | None = sections.get("simulate")
    if simulation is None or simulation.steps is None:
        return []
    tangents = len(entry_labels(sections["design"], system))
    try:
        require_memory(system, 1, simulation.steps, tangents, simulation.gradients != "forward")
    except InputError as error:
        return [Fault(("simulate", "steps"), f": {error}")]
    return []


def swept_index(name: str, names: Sequence[str]) -> int | None:
    """Return the index of a swept variable, named by its label or by a parameter of one entry; None if there is none."""
    if name in names:
        return names.index(name)
    entries = [k for k, label in enumerate(names) if label.rpartition("[")[0] == name]
    return entries[0] if len(entries) == 1 else None
