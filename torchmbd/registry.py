"""What extensions add to the core: public names, and entries of registries; imported when somebody looks one up.

torchmbd/extensions/__init__.py has the tables. No other file of the core names that folder (torchmbd/__init__.py for type
checkers), and none imports what is in it; without the folder the tables are empty.
Checked in tests/test_registry.py, tests/integrate/test_backend.py.
"""

from __future__ import annotations

import functools
import sys
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

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def missing(self, name: str) -> str | None:
        """Why a name of extensions is not there; None if it is, or if no extension has it."""
        unknown = name not in self._entries and _tables() is None  # nobody knows whether an extension has it
        return f"{EXTENSIONS} is not installed" if unknown else self.absence(name)

    def absence(self, name: str) -> str | None:
        """The text "the extension X is not installed" for a name of that extension; None for other names."""
        tables = _tables()
        entry = None if name in self._entries or tables is None else tables.ENTRIES[self._name].get(name)
        return None if entry is None else _absence(entry)

    def name_of(self, kind: object) -> str | None:
        """The name of an entry; None if it is none. An extension that has not been imported has none of its objects about."""
        return next((name for name, entry in self._entries.items() if self._loaded(entry) is kind), None)

    @staticmethod
    def _loaded(entry: Any) -> Any:
        if not isinstance(entry, str):
            return entry
        module, kind = entry.split(":")
        return getattr(sys.modules.get(f"{EXTENSIONS}.{module}"), kind, None)

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
    """Return what has a public name in an extension, such as "io.read_urdf", or the room of an extension, such as "fatigue".

    Raises AttributeError if no extension has the name, or if that extension is not installed.
    """
    tables = _tables()
    if tables is None:
        raise AttributeError(f"{_no_attribute(name)}; {EXTENSIONS} is not installed")
    if any(x.startswith(f"{name}.") for x in tables.NAMES.get(name, "").split()):
        if absence := _absence(name):
            raise AttributeError(f"mbd.{name}: {absence}")
        return import_module(f"{EXTENSIONS}.{name}")
    for module, names in tables.NAMES.items():
        if name in names.split():
            if absence := _absence(module):
                raise AttributeError(f"mbd.{name}: {absence}")
            return getattr(import_module(f"{EXTENSIONS}.{module}"), name.rpartition(".")[2])
    raise AttributeError(_no_attribute(name))


def rooms() -> list[str]:
    """Return the names of the extensions that are installed and are rooms: `mbd.vibrations` has the names of `vibrations`."""
    named = {name.partition(".")[0] for name in public_names()}
    tables = _tables()
    return sorted(named & set(tables.NAMES)) if tables is not None else []


def public_names() -> list[str]:
    """Return the names at `mbd.` of the extensions that are installed, with their rooms: "io.read_bdf"."""
    tables = _tables()
    named = {} if tables is None else tables.NAMES
    return [name for module, names in named.items() if not _absence(module) for name in names.split()]


def _entries(name: str) -> dict[str, str]:
    """Names of a registry -> "module:class", of the extensions that are installed."""
    tables = _tables()
    entries = {} if tables is None else tables.ENTRIES[name]
    return {key: entry for key, entry in entries.items() if not _absence(entry)}


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


def _absence(place: str) -> str:
    """What is not installed of the extension of a module or of an entry, or of those that it needs; "" if all is there."""
    extension = place.partition(":")[0].partition(".")[0]
    for needed in (extension, *_tables().NEEDS.get(extension, ())):
        spec = find_spec(f"{EXTENSIONS}.{needed}")
        if spec is None or spec.origin is None:
            if needed == extension:
                return f"the extension {extension} is not installed"
            return f"the extension {extension} needs the extension {needed}, which is not installed"
    return ""


def _no_attribute(name: str) -> str:
    module, _, attribute = f"torchmbd.{name}".rpartition(".")
    return f"module {module!r} has no attribute {attribute!r}"
