"""Responses as plain data: what an experiment file says, read with the registries.

    {max: {strain_energy: rod}}                                            a measure of a history
    {max: {strain_energy: rod}, window: [0.01, 0.03]}                      with options of the measure
    {rms: {velocity: {body: rod, node: right, axis: y}}}                   with arguments of the history
    {integral: {squared: {relative_displacement: {body: rod, a: left, b: right, axis: z}}}}
    {frequency: {body: rod, number: 2}}, {mass: rod}                       measures of the design
    {frequencies: {body: rod, cluster: [2, 3], power: -4}}
    {weighted_sum: [{weight: 0.6, integral: ...}, {weight: 0.4, rms: ...}], normalize: initial}

A single word stands for the first argument. Checked in tests/design/test_spec.py.
"""

from __future__ import annotations

import inspect
from collections.abc import Collection, Mapping
from typing import Any

from torchmbd.design.response import History, Measure
from torchmbd.design.responses import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.design.weighted import WeightedSum
from torchmbd.errors import InputError, nearest

SUM, SQUARED = "weighted_sum", "squared"
MEASURES = (*COMBINATORS, *OF_DESIGN, SUM)
HISTORIES = (*RESPONSES, SQUARED)
UNITS = {
    "strain_energy": "J",
    "position": "m",
    "displacement": "m",
    "velocity": "m/s",
    "acceleration": "m/s²",
    "relative_displacement": "m",
    "reaction": "N",
    "angle": "rad",
    "ply_failure": "",
    "ply_stress": "Pa",
    "frequency": "Hz",
    "frequencies": "Hz",
    "mass": "kg",
    "fatigue_damage": "",
    "fiber_curvature": "1/m",
    "fiber_divergence": "1/m",
}
Path = tuple[str | int, ...]


class SpecError(InputError):
    """A response that cannot be read: `path` leads to the wrong entry, `text` says what is wrong with it."""

    def __init__(self, path: Path, text: str):
        self.path, self.text = path, text
        super().__init__(f"{'.'.join(map(str, path)) or 'response'} {text}")


def measure_of(spec: Any, path: Path = ()) -> Measure:
    """Build a measure; SpecError for anything that is none."""
    name, options = _one(spec, MEASURES, path)
    inner = spec[name]
    if name == SUM:
        return _made(WeightedSum, (_terms(inner, (*path, name)),), options, path)
    if name in OF_DESIGN:
        if options:
            key = next(iter(options))
            raise SpecError((*path, key), f"unknown key{nearest(key, _arguments(OF_DESIGN[name]))}")
        return _of_words(OF_DESIGN[name], inner, (*path, name))
    return _made(COMBINATORS[name], (history_of(inner, (*path, name)),), options, path)


def history_of(spec: Any, path: Path = ()) -> History:
    """Build a history; SpecError for anything that is none."""
    name, options = _one(spec, HISTORIES, path)
    if options:
        key = next(iter(options))
        raise SpecError(
            (*path, key),
            f"unknown key: arguments of {name!r} stand inside it; allowed: {name}: {{{key}: {options[key]!r}, ...}}",
        )
    if name == SQUARED:
        return history_of(spec[name], (*path, name)) ** 2
    return _of_words(RESPONSES[name], spec[name], (*path, name))


def words(spec: Any, bodies: bool = True) -> str:
    """A valid response in a few words: `integral of strain energy of rod`; a sum says only that it is one."""
    [name] = [key for key in spec if key in MEASURES or key in HISTORIES]
    inner, said = spec[name], name.replace("_", " ")
    if name == SUM:
        return said
    if name == SQUARED:
        return f"{said} {words(inner, bodies)}"
    if name in COMBINATORS:
        return f"{said} of {words(inner, bodies)}"
    body = inner if isinstance(inner, str) else next(iter(inner.values()))
    return f"{said} of {body}" if bodies else said


def unit(spec: Any) -> str:
    """The unit of a valid response: `J s`; empty for a plain number, and for a sum, whose terms may have different ones."""
    [name] = [key for key in spec if key in MEASURES or key in HISTORIES]
    inner = spec[name]
    if name == SUM:
        return ""
    if name == "reaction" and isinstance(inner, Mapping) and inner.get("kind") == "torque":
        return "N m"
    if name in UNITS:
        return UNITS[name]
    own = unit(inner)
    if name == SQUARED and own:
        return f"({own})²" if " " in own or "/" in own else f"{own}²"
    return f"{own} s".strip() if name == "integral" else own


def heading(spec: Any) -> str:
    """A valid response as the title of an axis: `integral of strain energy of rod [J s]`."""
    return f"{words(spec)} [{unit(spec)}]" if unit(spec) else words(spec)


def leaf(spec: Any, path: Path = ()) -> Path:
    """The path to the innermost response of a valid one, to which its names belong."""
    [name] = [key for key in spec if key in MEASURES or key in HISTORIES]
    inner = spec[name]
    deeper = isinstance(inner, Mapping) and any(key in HISTORIES for key in inner)
    return leaf(inner, (*path, name)) if deeper else (*path, name)


def terms(spec: Any, path: Path = ()) -> list[tuple[dict[str, Any], Path]]:
    """The parts of a valid measure with their paths: the terms of a weighted sum, or the measure itself."""
    if SUM not in spec:
        return [(spec, path)]
    found = []
    for k, term in enumerate(spec[SUM]):
        found += terms({key: x for key, x in term.items() if key != "weight"}, (*path, SUM, k))
    return found


def _terms(spec: Any, path: Path) -> list[tuple[float, Measure]]:
    if not isinstance(spec, list) or not spec:
        raise SpecError(path, f"= {spec!r}: must be a list of measures, each with its weight")
    terms = []
    for k, term in enumerate(spec):
        here = (*path, k)
        if not isinstance(term, Mapping) or "weight" not in term:
            raise SpecError(here, f"= {term!r}: needs the key 'weight'; allowed: a measure and its weight")
        weight = term["weight"]
        if isinstance(weight, bool) or not isinstance(weight, (int, float)):
            raise SpecError((*here, "weight"), f"= {weight!r}: must be a number")
        terms.append((float(weight), measure_of({key: x for key, x in term.items() if key != "weight"}, here)))
    return terms


def _one(spec: Any, names: Collection[str], path: Path) -> tuple[str, dict[str, Any]]:
    """The one registered name among the keys, and the other keys."""
    if not isinstance(spec, Mapping):
        raise SpecError(path, f"= {spec!r}: must be a mapping (key: value)")
    found = [key for key in spec if key in names]
    if len(found) == 1:
        return found[0], {key: x for key, x in spec.items() if key != found[0]}
    if len(found) > 1 or not spec:
        raise SpecError(path, f"has {len(found)} keys; must have exactly one{nearest('', names)}")
    key = next(iter(spec))
    raise SpecError((*path, key), f"unknown name{nearest(key, names)}")


def _of_words(kind: type, spec: Any, path: Path) -> Any:
    """Build from the first argument as a word, or from a mapping of arguments."""
    if isinstance(spec, Mapping):
        return _made(kind, (), spec, path)
    if not isinstance(spec, str):
        raise SpecError(path, f"= {spec!r}: must be a name, or a mapping of {', '.join(_arguments(kind))}")
    return _made(kind, (spec,), {}, path)


def _made(kind: type, given: tuple, options: Mapping[str, Any], path: Path) -> Any:
    allowed = _arguments(kind)[len(given) :]
    for key in options:
        if key not in allowed:
            raise SpecError((*path, key), f"unknown key{nearest(key, allowed)}")
    parameters = list(inspect.signature(kind).parameters.values())[len(given) :]
    for parameter in parameters:
        if parameter.default is parameter.empty and parameter.name not in options:
            raise SpecError(path, f"needs {parameter.name!r}{nearest('', allowed)}")
    try:
        return kind(*given, **options)
    except InputError as error:
        raise SpecError(path, f": {error}") from error
    except (TypeError, ValueError) as error:
        raise SpecError(path, f"= {dict(options)!r}: {error}") from error


def _arguments(kind: type) -> list[str]:
    return list(inspect.signature(kind).parameters)
