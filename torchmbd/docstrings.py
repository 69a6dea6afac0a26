"""The meaning of each argument, read from the docstring that explains it.

    steps       equal steps of all motions; None: as many as
                the start needs                                     one entry: name, two spaces or more, meaning

Checked in tests/test_docstrings.py.
"""

from __future__ import annotations

import inspect
import re

_ENTRY = re.compile(r"(\w+(?:, \w+)*) {2,}(\S.*)")


def meanings(documented: object) -> dict[str, str]:
    """Argument -> its meaning in the docstring of a function or class; names that share a line share their meaning."""
    result: dict[str, str] = {}
    names: list[str] = []
    for line in inspect.cleandoc(getattr(documented, "__doc__", None) or "").splitlines():
        if entry := _ENTRY.fullmatch(line):
            names = [] if entry[2].startswith("as in ") else entry[1].split(", ")  # explained there
            result |= dict.fromkeys(names, entry[2])
        elif line.startswith("  ") and names:
            result |= {name: f"{result[name]} {line.strip()}" for name in names}
        else:
            names = []
    return result
