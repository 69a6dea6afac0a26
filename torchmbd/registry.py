"""What extensions add to the core: public names, and entries of registries; imported when somebody looks one up.

torchmbd/extensions/__init__.py has the tables. No other file of the core names that folder (torchmbd/__init__.py for type
checkers), and none imports what is in it; without the folder the tables are empty.
Checked in tests/test_registry.py, tests/integrate/test_backend.py.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, MutableMapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeVar

EXTENSIONS = "torchmbd.extensions"
T = TypeVar("T")


class Registry(MutableMapping[str, T]):
    """Names of experiment files -> classes: those of the core, and those that the table ENTRIES[name] of extensions adds.

    Names are complete from the start; an extension is imported when one of its classes is looked up.
    """

    def __init__(self, name: str, entries: Mapping[str, T]) -> None:
        self._name = name
        self._entries: dict[str, Any] = {**entries, **_entries(name)}

    def __getitem__(self, name: str) -> T:
        entry = self._entries[name]
        if isinstance(entry, str):
            module, kind = entry.split(":")
            entry = self._entries[name] = getattr(import_module(f"{EXTENSIONS}.{module}"), kind)
        return entry

    def missing(self, name: str) -> str | None:
        """Why a name of extensions is not there; None if it is, or if no extension has it."""
        if name in self._entries:
            return None
        tables = _tables()
        if tables is None:
            return f"{EXTENSIONS} is not installed"
        entry = tables.ENTRIES[self._name].get(name)
        return None if entry is None else f"the extension {_extension(entry)} is not installed"

    def __setitem__(self, name: str, kind: T) -> None:
        self._entries[name] = kind

    def __delitem__(self, name: str) -> None:
        del self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __repr__(self) -> str:
        return f"Registry({', '.join(self)})"


def public(name: str) -> Any:
    """What has a public name in an extension, such as "read_urdf"; AttributeError where nothing has, or it is not installed."""
    tables = _tables()
    if tables is None:
        raise AttributeError(f"module 'torchmbd' has no attribute {name!r}; {EXTENSIONS} is not installed")
    for module, names in tables.NAMES.items():
        if name in names.split():
            if not _is_installed(module):
                raise AttributeError(f"mbd.{name} is of the extension {_extension(module)}, which is not installed")
            return getattr(import_module(f"{EXTENSIONS}.{module}"), name.rpartition(".")[2])
    raise AttributeError(f"module 'torchmbd' has no attribute {name!r}")


def public_names() -> list[str]:
    """Names at `mbd.` of the extensions that are installed."""
    tables = _tables()
    named = {} if tables is None else tables.NAMES
    return [name for module, names in named.items() if _is_installed(module) for name in names.split()]


def _entries(name: str) -> dict[str, str]:
    """Names of a registry -> "module:class", of the extensions that are installed."""
    tables = _tables()
    entries = {} if tables is None else tables.ENTRIES[name]
    return {key: entry for key, entry in entries.items() if _is_installed(entry)}


@functools.cache
def _tables() -> Any:
    """The module with the tables; None without the folder."""
    try:
        tables = import_module(EXTENSIONS)
    except ModuleNotFoundError as error:
        if error.name != EXTENSIONS:
            raise
        return None
    return tables if tables.__file__ else None  # else a folder that has lost its files


def _extension(place: str) -> str:
    """The extension of a module "extension", "extension.file" or of an entry "extension.file:class"."""
    return place.partition(":")[0].partition(".")[0]


def _is_installed(place: str) -> bool:
    spec = find_spec(f"{EXTENSIONS}.{_extension(place)}")
    return spec is not None and spec.origin is not None
