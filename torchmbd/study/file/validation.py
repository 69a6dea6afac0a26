"""Validation of the data of an experiment file: its valid sections, and the faults of the others.

Messages of pydantic are rewritten: the path as an override spells it, the value, what is allowed and the nearest valid name.
Where one section is faulty, each of the others is validated by itself, and so is each entry of a section of several.
"""

from __future__ import annotations

import types
from functools import cache
from typing import Any, NamedTuple, Union, cast, get_args, get_origin

from pydantic import ValidationError, create_model
from pydantic_core import ErrorDetails

from torchmbd.errors import Path, must, nearest
from torchmbd.math.units import NONE, fitting, in_si, number_with_unit
from torchmbd.study.file.faults import Fault, shown
from torchmbd.study.file.schema import LIMIT_KINDS, UNITS, Section
from torchmbd.tracking.uri import StoreURI

_FUNCTION = "package.module:function or path/to/file.py:function"
#: What is allowed as the value of required keys.
_ALLOWED = {
    "model": _FUNCTION,
    "figures": _FUNCTION,
    "design": "must have parameters of the model, each with lower, upper and unit",
    "simulate": "must have duration, and what else torchmbd.simulate takes",
    "minimize": "a response, such as {integral: {strain_energy: rod}}",
    "unit": f"one of {', '.join(UNITS)}",
    "count": "a whole number",
    **dict.fromkeys(("lower", "upper", "duration", "from", "to"), "a number"),
}
_FLOATS = ("float_type", "float_parsing")
#: Kind of an error of pydantic -> what is allowed, with the numbers of the error.
_RULES = {
    **dict.fromkeys(("int_type", "int_parsing", "int_parsing_size"), "a valid integer"),
    "int_from_float": "a valid integer, without a fraction",
    **dict.fromkeys(_FLOATS, "a valid number"),
    "finite_number": "a finite number",
    **dict.fromkeys(("string_type", "string_unicode"), "a valid string"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    "list_type": "a valid list",
    "literal_error": "{expected}",
    "greater_than": "greater than {gt:.12g}",
    "greater_than_equal": "greater than or equal to {ge:.12g}",
    "less_than": "less than {lt:.12g}",
    "less_than_equal": "less than or equal to {le:.12g}",
    "string_too_short": "must have at least {min_length} character",
    "string_too_long": "must have at most {max_length} characters",
    "string_pattern_mismatch": "must match the pattern {pattern}",
    "too_short": "must have at least {min_length} item",
    "too_long": "must have at most {max_length} items",
}
_WITH_UNITS = ("design", "subject_to")  # sections whose entries have a unit; that of a limit may be left out
#: Sections of several entries, each of which can be checked alone.
_OF_ENTRIES = ("design", "links", "tradeoff", "subject_to", "scenarios")


def validate(data: Any, kind: type[Section]) -> tuple[dict[str, Any], list[Fault]]:
    """Return the sections that are valid, by name, and the faults of the others; `kind`: what the file is to be.

    Of a section with faulty entries, such as scenarios, these are None, and the others valid.
    """
    if not isinstance(data, dict):
        keys = ", ".join(f"{key}:" for key in _keys((), kind))
        return {}, [Fault((), f"is {shown(data)}: must have sections such as {keys}")]
    try:
        return dict(kind.model_validate(data)), []
    except ValidationError as error:
        faults = _faults(error, data, kind)
    sections: dict[str, Any] = {}
    for name in kind.model_fields:
        paths = [fault.path for fault in faults if fault.path[:1] == (name,)]
        if not paths:
            alone = _alone(kind, name).model_validate({name: data[name]} if name in data else {})
            sections[name] = getattr(alone, name)
        elif name in _OF_ENTRIES and all(len(path) > 1 for path in paths):
            sections[name] = _entries(kind, name, data[name], {path[1] for path in paths})
    return sections, faults


@cache
def _alone(kind: type[Section], name: str) -> type[Section]:
    """Return a model of one section of a file."""
    field = kind.model_fields[name]
    fields: dict[str, Any] = {
        name: (field.rebuild_annotation(), field.get_default(call_default_factory=True, validated_data={}))
    }
    return create_model(name, __base__=Section, **fields)


def _entries(kind: type[Section], name: str, data: Any, wrong: set[str | int]) -> Any:
    """Return the entries of a section, None for those that are `wrong`."""
    entry = create_model(name, __base__=Section, entry=(get_args(_plain(kind.model_fields[name].annotation))[-1], ...))
    items = data.items() if isinstance(data, dict) else enumerate(data)
    valid = {key: None if key in wrong else dict(entry.model_validate({"entry": x}))["entry"] for key, x in items}
    return valid if isinstance(data, dict) else list(valid.values())


def _faults(error: ValidationError, data: Any, kind: type[Section]) -> list[Fault]:
    found: dict[Path, list[_Refusal]] = {}
    located = [(_path(details, data), details) for details in error.errors(include_url=False)]
    for path, details in located:
        if isinstance(details["input"], list) and any(other[:-1] == path for other, _ in located):
            continue  # not the list is wrong but an entry of it
        refusal = _refusal(details, path, kind)
        if refusal not in found.setdefault(path, []):
            found[path].append(refusal)
    return [Fault(path, _either(alternatives)) for path, alternatives in found.items()]


def _path(details: ErrorDetails, data: Any) -> Path:
    """Keep what the file itself holds of pydantic's location, not the branches of its own types."""
    path: Path = ()
    location = details["loc"]
    for k, part in enumerate(location):
        inside = part in data if isinstance(data, dict) else isinstance(data, list) and part in range(len(data))
        if inside:
            data, path = cast(Any, data)[part], (*path, part)
        elif details["type"] == "missing" and k == len(location) - 1:
            path = (*path, part)
    return (*path, *details.get("ctx", {}).get("path", ()))


class _Refusal(NamedTuple):
    """Why the schema refuses a value; the fields are explained at `InputError`."""

    state: str
    allowed: str = ""
    hint: str = ""

    @property
    def clause(self) -> str:
        """The fault as it follows the key, without the remedy: "= -1: must be greater than 0"."""
        return ": ".join(x for x in (self.state, must(self.allowed)) if x)


def _refusal(details: ErrorDetails, path: Path, kind_of_file: type[Section]) -> _Refusal:
    kind, value, context = details["type"], _shown_input(details, path), details.get("ctx", {})
    is_value = f"= {shown(value)}"
    if kind == "missing":
        is_unit = path[0] == "design" and path[-1] == "unit"
        return _Refusal("is missing", fitting(str(path[1])) if is_unit else _ALLOWED.get(str(path[-1]), "given"))
    if kind == "extra_forbidden":
        keys = _keys(path[:-1], kind_of_file)
        return _Refusal(f"{is_value} is an unknown key", must(keys), nearest(path[-1], keys))
    if kind == "string_pattern_mismatch" and path in (("model",), ("figures",), ("simulate", "phases")):
        return _Refusal(is_value, _ALLOWED["model"])
    if kind == "response" and path[0] == "subject_to" and len(path) == 3:  # perhaps a limit that is misspelt
        return _Refusal(f"{context['state']}; a limit is one of {', '.join(LIMIT_KINDS)}")
    if kind in ("fault", "response"):
        return _Refusal(context["state"], context["allowed"], context["hint"])
    if kind in ("model_type", "dict_type"):
        return _Refusal(is_value, "a mapping (key: value)")
    if kind == "too_short" and path == ("design",):
        return _Refusal("is empty", "must have at least one parameter of the model")
    if kind in ("too_short", "too_long") and isinstance(value, dict):
        least = context.get("min_length", 1)
        count = "exactly one" if path == ("sweep",) else f"{least} or more"
        return _Refusal(f"has {len(value)} keys", f"must have {count}")
    if kind in _RULES:
        return _Refusal(
            is_value, _RULES[kind].format(**context), _without_unit(value, path[0]) if kind in _FLOATS else ""
        )
    return _Refusal(f"{is_value}: {details['msg']}")


def _without_unit(value: object, section: object) -> str:
    """Return the remedy for a text such as "1 mm" in place of a number; "" if it is no number with a unit."""
    written = number_with_unit(value)
    if written is None or written[1] == NONE or section not in _WITH_UNITS:
        return in_si(value)
    beside = f"{written[0]:g} and unit: {written[1]}"
    return beside if section == "design" else f"{in_si(value)}, or {beside}"


def _shown_input(details: ErrorDetails, path: Path) -> object:
    """Return the value of a fault, the user part of a store's URI hidden, whatever is wrong with it."""
    value = details["input"]
    return str(StoreURI(value)) if path == ("tracking", "uri") and isinstance(value, str) else value


def _either(refusals: list[_Refusal]) -> str:
    """Join the refusals of the branches of a union about one value, which is shown once; a remedy comes last."""
    first, *others = refusals
    clauses = [first.clause, *(x.allowed if x.state == first.state else x.clause for x in others)]
    hint = next((x.hint for x in refusals if x.hint), "")
    return "; or ".join(clauses) + (f". Try: {hint}" if hint else "")


def _keys(path: Path, section: Any) -> list[str]:
    """Return the keys that a part of a file may have."""
    for part in path:
        if isinstance(section, type) and issubclass(section, Section):
            section = _plain(section.model_fields[str(part)].annotation)
        else:
            section = _plain(get_args(section)[-1])
    return [field.alias or name for name, field in section.model_fields.items()]


def _plain(annotation: Any) -> Any:
    """Strip Annotated and Optional."""
    if get_origin(annotation) in (Union, types.UnionType):
        return next(_plain(branch) for branch in get_args(annotation) if branch is not type(None))
    if getattr(annotation, "__metadata__", None):
        return _plain(get_args(annotation)[0])
    return annotation
