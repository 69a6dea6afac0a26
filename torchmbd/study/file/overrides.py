"""`key=value` on the command line: the same file with one value changed.

    optimizer.max_iterations=5                dotted path into the file, the value read as YAML
    subject_to.0.at_most=0.5                  a number is an index of a list
    design.rod.laminate.angles.start=[10]     names of design variables contain dots: of several keys of the file that
                                              fit the path, the longest is taken

    options.layers=1,2,3                      several values: one study for each, all combinations of such lists

An override may set a key that the file leaves to its default. Checked in tests/study/file/test_overrides.py.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import product
from typing import Any

import yaml

from torchmbd.errors import Path, dotted, must_be_one
from torchmbd.study.file.faults import Fault, StudyError
from torchmbd.study.file.yaml_file import Document, parse_yaml

_NAMED_BY_PARAMETERS = ("design", "sweep", "parameters")  # sections whose keys are dotted names


def combinations(assignments: Sequence[str]) -> list[tuple[str, ...]]:
    """Spread `key=1,2,3` over several lists of assignments; a comma inside brackets or quotes separates nothing."""
    choices = []
    for text in assignments:
        key, equals, written = text.partition("=")
        values = _split(written)
        choices.append([text] if len(values) < 2 else [f"{key}{equals}{value}" for value in values])
    return list(product(*choices))


def _split(text: str) -> list[str]:
    """Return the entries of a list in YAML without its brackets, as they are written."""
    whole = f"[{text}]"
    try:
        entries = yaml.compose(whole, Loader=yaml.SafeLoader).value
    except yaml.YAMLError:
        return [text]
    return [whole[entry.start_mark.index : entry.end_mark.index] for entry in entries]


def override(document: Document, assignments: Sequence[str], named_by_parameters: Sequence[str] = ()) -> None:
    """Apply all assignments to the document; StudyError with each one that cannot be applied.

    named_by_parameters  further sections whose keys are dotted names (kind.py)
    """
    sections = (*_NAMED_BY_PARAMETERS, *named_by_parameters)
    faults = [fault for text in assignments if (fault := _assign(document, text, sections))]
    if faults:
        raise StudyError(document.source, faults)


def _assign(document: Document, text: str, sections: Collection[str]) -> Fault | None:
    key, equals, written = text.partition("=")
    key = key.strip()
    if not equals or not key or not all(key.split(".")):
        return Fault((), "is not of the form key=value", f"override {text!r}")
    try:
        value = parse_yaml(written, f"override {text!r}").data
    except StudyError as error:
        return Fault((key,), error.faults[0].text, f"override {text!r}")
    if document.data is None:
        document.data = {}
    try:
        path = _resolve(document.data, key.split("."), sections)
    except LookupError as error:
        return Fault((), str(error.args[0]), f"override {text!r}")
    _set(document.data, path, value)
    for known in [known for known in document.lines if known[: len(path)] == path]:
        del document.lines[known]  # of the replaced value
    document.lines[path] = f"override {text!r}"
    return None


def _resolve(data: Any, words: list[str], sections: Collection[str]) -> Path:
    """Return the path of a dotted key; LookupError if there is none. `sections`: those whose keys are dotted names."""
    path: Path = ()
    while words:
        if isinstance(data, dict):
            count = next((n for n in range(len(words), 0, -1) if ".".join(words[:n]) in data), 0)
            if not count:  # a new key
                count = len(words) - 1 if path and path[-1] in sections and len(words) > 1 else 1
            key, words = ".".join(words[:count]), words[count:]
            data = data.get(key)
        elif isinstance(data, list):
            key, words = _index(words[0], data, path), words[1:]
            data = data[key]
        elif data is None:
            return (*path, *words)
        else:
            raise LookupError(f"{dotted(path)} is the value {data!r} and has no parts")
        path = (*path, key)
    return path


def _index(word: str, items: list[Any], path: Path) -> int:
    if not word.isascii() or not word.isdigit() or int(word) >= len(items):
        raise LookupError(
            f"{dotted((*path, word))}: no such place in a list of {len(items)}: {must_be_one(word, range(len(items)))}"
        )
    return int(word)


def _set(data: Any, path: Path, value: Any) -> None:
    for key in path[:-1]:
        if isinstance(data, dict) and data.get(key) is None:
            data[key] = {}
        data = data[key]
    data[path[-1]] = value
