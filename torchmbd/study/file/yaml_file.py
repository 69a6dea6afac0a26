"""A strict reader of YAML: it returns the data as written, or names each fault with its line.

The data are built from the events of PyYAML's parser, not by its constructors, so that

    1e-4, 1.e3, .5       are floats (PyYAML: strings)
    on, yes, off, no     are strings (PyYAML: booleans); only true and false are booleans
    007, 0x1F, 1_000     are strings (PyYAML: octal, hexadecimal, ...), so that a number field refuses them
    12:30, 2026-01-01    are strings (PyYAML: base 60, dates)
    a key given twice    is an error (PyYAML: the last one wins)
    !tag, &anchor, *name are errors: a file cannot run code or expand itself

Assumed: one document of nested mappings, sequences and scalars. Checked in tests/study/file/test_yaml_file.py.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import yaml

from torchmbd.errors import InputError, Path
from torchmbd.study.file.faults import Fault, StudyError
from torchmbd.tracking.uri import StoreURI, hidden

_MAX_BYTES = 1_000_000
_MAX_DEPTH = 20
_MAX_DIGITS = 18  # of an int64; a longer number is a typing error
_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+)")
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}


@dataclass
class Document:
    """Plain data (dict, list, str, int, float, bool, None), and the line or override that set each path."""

    source: str
    data: Any
    lines: dict[Path, int | str] = field(default_factory=dict)


def read_yaml(path: str | FilePath) -> Document:
    """Read a file; StudyError with every fault and its line."""
    if not isinstance(path, (str, FilePath)):
        raise InputError("file", path, "the path of a file")
    file = FilePath(path)
    try:
        content = file.read_bytes()
    except OSError as error:
        raise StudyError(str(path), [Fault((), f"cannot be read: {error.strerror}")]) from None
    if len(content) > _MAX_BYTES:
        fault = Fault((), f"has {len(content)} bytes: must have at most {_MAX_BYTES}")
        raise StudyError(str(path), [fault])
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise StudyError(str(path), [Fault((), f"is not UTF-8 text (byte {error.start})", line)]) from None
    return parse_yaml(text, str(path))


_QUOTED = """. Try: within { }, names with [ ] in quotes, such as {"rod.laminate.angles[0]": -1}"""


def parse_yaml(text: str, source: str = "<text>") -> Document:
    """Read a text; StudyError with every fault and its line."""
    builder = _Builder(source)
    try:
        builder.document(iter(yaml.parse(text, Loader=yaml.SafeLoader)))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        hint = _QUOTED if mark and text[mark.index : mark.index + 1] == "[" else ""
        line = mark.line + 1 if mark else None
        builder.faults.append(Fault((), f"is not YAML: {error.problem or error.context}{hint}", line))
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        problem = f"unacceptable character #x{ord(text[error.position]):04x}"
        builder.faults.append(Fault((), f"is not YAML: {problem}: must have printable characters alone", line))
    except yaml.YAMLError as error:
        builder.faults.append(Fault((), f"is not YAML: {str(error).splitlines()[0]}", 1))
    if builder.faults:
        raise StudyError(source, builder.faults)
    return Document(source, builder.data, {(): 1} | builder.lines)


def scalar(text: str) -> Any:
    """Read a plain scalar: number, true, false, null, else the text itself; ValueError for a number out of range."""
    if text.lower() in _WORDS and text in (text.lower(), text.upper(), text.capitalize()):
        return _WORDS[text.lower()]
    if _INT.fullmatch(text):
        if len(text) > _MAX_DIGITS:
            raise ValueError(f"has {len(text)} digits: must have at most {_MAX_DIGITS}")
        return int(text)
    if _FLOAT.fullmatch(text):
        value = float(text)
        if not math.isfinite(value):
            raise ValueError(f"= {text}: must be at most 1.8e308, the largest float")
        return value
    return text


def without_user(text: str) -> str:
    """Return the text of an experiment file with the user part of its store, and of every other URI, hidden."""
    for key, section in _entries(yaml.compose(text, Loader=yaml.SafeLoader)):
        for inner, node in _entries(section) if key == "tracking" else ():
            if inner == "uri" and isinstance(node, yaml.ScalarNode) and str(StoreURI(node.value)) != node.value:
                written = json.dumps(str(StoreURI(node.value)))  # however it was quoted and folded
                text = text[: node.start_mark.index] + written + text[node.end_mark.index :]
    return hidden(text)


def _entries(node: yaml.Node | None) -> list[tuple[str, yaml.Node]]:
    return [(key.value, value) for key, value in node.value] if isinstance(node, yaml.MappingNode) else []


class _Builder:
    """Builds plain data from the events of the parser, and collects the faults."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.data: Any = None
        self.lines: dict[Path, int | str] = {}
        self.faults: list[Fault] = []

    def document(self, events: Iterator[yaml.Event]) -> None:
        documents = 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self.fault((), "a second document (---): must have one document", event)
                    return
                self.data = self.value(next(events), events, ())

    def value(self, event: yaml.Event, events: Iterator[yaml.Event], path: Path) -> Any:
        self.lines.setdefault(path, event.start_mark.line + 1)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            self.fault(path, "must be plain values, without anchors (&) and aliases (*)", event)
        if tag := getattr(event, "tag", None):
            self.fault(path, f"must be a plain value, without the tag {tag!r}", event)
        if isinstance(event, yaml.CollectionStartEvent) and len(path) >= _MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nested more than {_MAX_DEPTH} deep", problem_mark=event.start_mark)
        if isinstance(event, yaml.MappingStartEvent):
            return self.mapping(events, path)
        if isinstance(event, yaml.SequenceStartEvent):
            return self.sequence(events, path)
        if isinstance(event, yaml.ScalarEvent):
            return self.leaf(event, path)
        return None

    def mapping(self, events: Iterator[yaml.Event], path: Path) -> dict[str, Any]:
        result: dict[str, Any] = {}
        first: dict[str, int] = {}
        while not isinstance(event := next(events), yaml.MappingEndEvent):
            line = event.start_mark.line + 1
            if not isinstance(event, yaml.ScalarEvent):
                raise yaml.MarkedYAMLError(problem="a key must be a plain word", problem_mark=event.start_mark)
            self.value(event, iter(()), (*path, event.value))  # a tag or an anchor on a key is a fault as well
            key = event.value
            if key in first:
                self.fault((*path, key), f"is given twice (first in line {first[key]}): must be given once", event)
            first.setdefault(key, line)
            self.lines[(*path, key)] = line
            result[key] = self.value(next(events), events, (*path, key))
        return result

    def sequence(self, events: Iterator[yaml.Event], path: Path) -> list[Any]:
        result: list[Any] = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            result.append(self.value(event, events, (*path, len(result))))
        return result

    def leaf(self, event: yaml.ScalarEvent, path: Path) -> Any:
        if not event.implicit[0]:  # quoted or tagged: text
            return event.value
        try:
            return scalar(event.value)
        except ValueError as error:
            self.fault(path, str(error), event)
            return event.value

    def fault(self, path: Path, text: str, event: yaml.Event) -> None:
        self.faults.append(Fault(path, text, event.start_mark.line + 1))
