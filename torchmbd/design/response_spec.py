"""Responses as plain data, as in experiment files, and how they are read with the registries.

    {max: {strain_energy: rod}}                                            a measure of a history
    {max: {strain_energy: rod}, window: [0.01, 0.03]}                      with options of the measure
    {rms: {velocity: {body: rod, node: right, axis: y}}}                   with arguments of the history
    {frequency: {body: rod, number: 2}}, {mass: rod}                       measures of the design
    {frequency: {body: rod, supports: {left: all}}}
    {mean_frequency: {body: rod, cluster: [2, 3], power: -4}}
    {aggregate: [{max: ...}, {at_times: ...}], kind: ks, sharpness: 50}     the largest of their rows, smooth
    {weighted_sum: [{weight: 0.6, integral: ...}, {weight: 0.4, rms: ...}], normalize: initial}

Operations on histories, and on measures of one number; a number may stand for any but the first:

    {sum: [...]}, {difference: [a, b]}, {product: [...]}, {quotient: [a, b]}, {absolute: a}, {squared: a}, {scaled: a, by: 1e3}

A history or a measure that a user writes, with its options; see `_function`:

    {function: "package.module:name", tip: right}, {max: {function: "beside.py:name"}}

A single word is the first argument. Checked in tests/design/test_spec.py.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from difflib import SequenceMatcher
from functools import partial, reduce
from operator import add, mul, sub, truediv
from typing import Any

from torchmbd.design.aggregate import Aggregate
from torchmbd.design.functions import FunctionHistory, FunctionMeasure
from torchmbd.design.response import History, Measure
from torchmbd.design.responses import COMBINATORS, OF_DESIGN, RESPONSES
from torchmbd.design.weighted import WeightedSum
from torchmbd.errors import InputError, Path, must_be_one
from torchmbd.math.checked_numbers import is_real

SUM, FUNCTION, SCALED, AGGREGATE = "weighted_sum", "function", "scaled", "aggregate"
SEVERAL: dict[str, Callable[[Any, Any], Any]] = {"sum": add, "difference": sub, "product": mul, "quotient": truediv}
SINGLE: dict[str, Callable[[Any], Any]] = {"absolute": abs, "squared": lambda y: y**2}
OPERATIONS = (*SEVERAL, *SINGLE, SCALED)
MEASURES = (*COMBINATORS, *OF_DESIGN, SUM, AGGREGATE, *OPERATIONS, FUNCTION)
HISTORIES = (*RESPONSES, *OPERATIONS, FUNCTION)
Find = Callable[[str], Any]  # returns the function of a name such as `package.module:name`


class SpecError(InputError):
    """A response that cannot be read: `path` is the keys to the wrong entry, `state` the reason."""

    def __init__(self, path: Path, text: str):
        super().__init__(path, state=text, noun="" if path else "response")


def measure_of(spec: Any, path: Path = (), find: Find | None = None) -> Measure:
    """Build a measure; SpecError for data that describes none. Without `find`, functions of a user are not imported."""
    name, options = _name_and_options(spec, MEASURES, path)
    inner = spec[name]
    if name in OPERATIONS:
        return _operation(name, inner, options, path, partial(measure_of, find=find))
    if name == FUNCTION:
        return _function(inner, options, path, find, Measure)
    if name == SUM:
        return _built(WeightedSum, (_terms(inner, (*path, name), find),), options, path)
    if name == AGGREGATE:
        specs = inner if isinstance(inner, list) else [inner]
        parts = [measure_of(x, (*path, name, k), find) for k, x in enumerate(specs)]
        return _built(Aggregate, (parts,), options, path)
    if name in OF_DESIGN:
        if options:
            key = next(iter(options))
            raise SpecError((*path, key), f"is an unknown key: {must_be_one(key, _arguments(OF_DESIGN[name]))}")
        return _from_word(OF_DESIGN[name], inner, (*path, name))
    return _built(COMBINATORS[name], (history_of(inner, (*path, name), find),), options, path)


def history_of(spec: Any, path: Path = (), find: Find | None = None) -> History:
    """Build a history; SpecError for data that describes none."""
    name, options = _name_and_options(spec, HISTORIES, path)
    if name in OPERATIONS:
        return _operation(name, spec[name], options, path, partial(history_of, find=find))
    if name == FUNCTION:
        return _function(spec[name], options, path, find, History)
    if options:
        key = next(iter(options))
        outer = str(path[-1]) if path else ""
        if key not in _arguments(RESPONSES[name]) and outer in COMBINATORS and key in _arguments(COMBINATORS[outer]):
            words = f"an argument of {outer!r} stands beside it. Try: {outer}: {{...}}, {key}: {options[key]!r}"
        else:
            words = f"arguments of {name!r} stand inside it. Try: {name}: {{{key}: {options[key]!r}, ...}}"
        raise SpecError((*path, key), f"is an unknown key: {words}")
    return _from_word(RESPONSES[name], spec[name], (*path, name))


def leaf(spec: Any, path: Path = ()) -> Path:
    """The path to the innermost history or measure of a valid response, whose arguments name bodies, nodes and joints."""
    [name] = [key for key in spec if key in MEASURES or key in HISTORIES]
    inner = spec[name]
    contains_history = isinstance(inner, Mapping) and any(key in HISTORIES for key in inner)
    return leaf(inner, (*path, name)) if contains_history else (*path, name)


def terms(spec: Any, path: Path = ()) -> list[tuple[dict[str, Any], Path]]:
    """The operands of a valid measure with their paths: the terms of sums and other operations, or the measure itself."""
    [name] = [key for key in spec if key in MEASURES]
    if name not in (SUM, AGGREGATE, *OPERATIONS):
        return [(spec, path)]
    inner = spec[name]
    if not isinstance(inner, list):
        return terms(inner, (*path, name))
    result = []
    for k, term in enumerate(inner):
        if isinstance(term, Mapping):
            result += terms({key: x for key, x in term.items() if key != "weight"}, (*path, name, k))
    return result


def functions(spec: Any) -> list[Any]:
    """All names of functions of a user in a response or a list of constraints."""
    if isinstance(spec, Mapping):
        named = [spec[FUNCTION]] if FUNCTION in spec else []
        return named + [name for inner in spec.values() for name in functions(inner)]
    return [name for inner in spec for name in functions(inner)] if isinstance(spec, list) else []


def _operation(name: str, spec: Any, options: Mapping[str, Any], path: Path, read: Callable[..., Any]) -> Any:
    """The operation `name` on its operands, which `read` builds."""
    entry = (*path, name)
    for key in options:
        if name != SCALED or key != "by":
            raise SpecError((*path, key), f"is an unknown key: {must_be_one(key, ['by'] if name == SCALED else [])}")
    if name in SINGLE:
        return _combined(SINGLE[name], entry, read(spec, entry))
    if name == SCALED:
        if not is_real(options.get("by")):
            raise SpecError((*path, "by"), f"= {options.get('by')!r}: must be a number, that {name!r} multiplies by")
        return _combined(mul, entry, read(spec, entry), options["by"])
    exact = 2 if name in ("difference", "quotient") else None
    if not isinstance(spec, list) or len(spec) < 2 or (exact and len(spec) != exact):
        raise SpecError(entry, f"= {spec!r}: must be a list of {'two' if exact else 'two or more'} responses")
    parts = [x if k and is_real(x) else read(x, (*entry, k)) for k, x in enumerate(spec)]
    return reduce(partial(_combined, SEVERAL[name], entry), parts)


def _combined(operation: Callable[..., Any], path: Path, *parts: Any) -> Any:
    try:
        return operation(*parts)
    except InputError as error:
        raise SpecError(path, f": {error}") from error


def _function(spec: Any, options: Mapping[str, Any], path: Path, find: Find | None, kind: type) -> Any:
    """The response of the object that `spec` names, which is one of these.

    A function of the motion, annotated `-> Tensor`: [lanes, times] for a history, [lanes] for a measure; its first argument is
    the motion, its others are the options. A function of the options, annotated `-> mbd.History` or `-> mbd.Measure`. A history
    or a measure, such as `@mbd.history` makes, without options.
    """
    entry = (*path, FUNCTION)
    response_of = FunctionHistory if kind is History else FunctionMeasure
    if not isinstance(spec, str) or not all(spec.rpartition(":")[::2]):
        raise SpecError(entry, f"= {spec!r}: must be package.module:function or path/to/file.py:function")
    if find is None:
        return response_of(_not_imported)
    try:
        function = find(spec)
    except InputError as error:
        raise SpecError(entry, error.reason) from error
    noun = kind.__name__.lower()
    if not inspect.isfunction(function):
        if not isinstance(function, kind) or options:
            what = (
                f"is {function!r}" if not isinstance(function, kind) else f"takes no options, but has {list(options)}"
            )
            raise SpecError(entry, f"= {spec!r}: {what}: must be a {noun}, or a function with its options")
        return function
    annotation = function.__annotations__.get("return")
    returned = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", repr(annotation))
    returned = returned.rpartition(".")[2]
    if returned not in ("Tensor", kind.__name__):
        has_annotation = "return" in function.__annotations__
        what = f"is annotated -> {returned}" if has_annotation else "does not say what it returns"
        raise SpecError(
            entry,
            f"= {spec!r}: {what}: must be annotated with -> Tensor or -> {kind.__name__}, or have @mbd.{noun} above it",
        )
    of_motion = returned == "Tensor"
    _check_options(function, options, 1 if of_motion else 0, path)
    if of_motion:
        return response_of(partial(function, **options) if options else function)
    result = _combined(partial(function, **options), entry)
    if not isinstance(result, kind):
        raise SpecError(entry, f"= {spec!r}: returned {result!r}: must return a {noun}")
    return result


def _check_options(function: Callable[..., Any], options: Mapping[str, Any], before: int, path: Path) -> None:
    """SpecError for options that a function does not take, or that are missing; `before`: number of arguments before them."""
    parameters = list(inspect.signature(function).parameters.values())[before:]
    names = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for key in options:
        if key not in names and not takes_any:
            raise SpecError((*path, key), f"is an unknown key: {must_be_one(key, names)}")
    needed = [p.name for p in parameters if p.name in names and p.default is p.empty]
    for name in needed:
        if name not in options:
            may = [x for x in names if x not in needed]
            more = f", and may have {', '.join(may)}" if may else ""
            raise SpecError(path, f"lacks {name!r}: must have {', '.join(needed)}{more}")


def _not_imported(motion: Any) -> Any:
    raise RuntimeError("a function of an experiment file was not looked up")


def _terms(spec: Any, path: Path, find: Find | None) -> list[tuple[float, Measure]]:
    if not isinstance(spec, list) or not spec:
        raise SpecError(path, f"= {spec!r}: must be a list of measures, each with its weight")
    terms = []
    for k, term in enumerate(spec):
        entry = (*path, k)
        if not isinstance(term, Mapping) or "weight" not in term:
            raise SpecError(entry, f"= {term!r}: must be a measure with a weight")
        weight = term["weight"]
        if not is_real(weight):
            raise SpecError((*entry, "weight"), f"= {weight!r}: must be a number")
        terms.append((float(weight), measure_of({key: x for key, x in term.items() if key != "weight"}, entry, find)))
    return terms


def _name_and_options(spec: Any, names: Collection[str], path: Path) -> tuple[str, dict[str, Any]]:
    """The one registered name among the keys, and the other keys."""
    if not isinstance(spec, Mapping):
        raise SpecError(path, f"= {spec!r}: must be a mapping (key: value)")
    known = [key for key in spec if key in names]
    if len(known) == 1:
        return known[0], {key: x for key, x in spec.items() if key != known[0]}
    if len(known) > 1 or not spec:
        raise SpecError(path, f"has {len(known)} keys: must have exactly one of {', '.join(names)}")
    # Of several keys the name is the one that resembles a name: the others are its options, such as a window.
    key = max(spec, key=lambda key: max(SequenceMatcher(None, str(key), name).ratio() for name in names))
    registries = (RESPONSES, COMBINATORS, OF_DESIGN)
    for absent in spec:  # a name of an extension, whatever its options resemble
        if absence := next((why for x in registries if (why := x.absence(str(absent)))), None):
            raise SpecError((*path, absent), f": {absence}")
    missing = next((f"; {why}" for x in registries if (why := x.missing(key))), "")
    raise SpecError((*path, key), f"is an unknown name: {must_be_one(key, names)}{missing}")


def _from_word(kind: type, spec: Any, path: Path) -> Any:
    """An object of class `kind` from its first argument as a word, or from a mapping of arguments."""
    if isinstance(spec, Mapping):
        return _built(kind, (), spec, path)
    if not isinstance(spec, str):
        raise SpecError(path, f"= {spec!r}: must be a name, or a mapping of {', '.join(_arguments(kind))}")
    return _built(kind, (spec,), {}, path)


def _built(kind: type, first: tuple, options: Mapping[str, Any], path: Path) -> Any:
    """An object of class `kind` from its first arguments and its options; SpecError for options that it does not take."""
    _check_options(kind, options, len(first), path)
    try:
        return kind(*first, **options)
    except InputError as error:
        if error.path[:1] and error.path[0] in options:
            raise SpecError((*path, error.path[0]), error.reason) from error
        raise SpecError(path, f": {error}") from error
    except (TypeError, ValueError) as error:
        raise SpecError(path, f"= {dict(options)!r}: {error}") from error


def _arguments(kind: type) -> list[str]:
    return list(inspect.signature(kind).parameters)
