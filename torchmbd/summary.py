"""Short descriptions of objects: some lines in a terminal, a table in a notebook.

Checked in tests/test_summary.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any


class Summary:
    """An object that says what it is in a few rows, whatever it holds."""

    def _summary(self) -> Iterable[tuple[str, Any]]:
        """Pairs of a label and what stands beside it."""
        raise NotImplementedError

    def __repr__(self) -> str:
        rows = list(self._summary())
        width = max((len(label) for label, _ in rows), default=0)
        return "\n".join([type(self).__name__, *(f"  {label:<{width}}  {x}" for label, x in rows)])

    def _repr_html_(self) -> str:
        return f"<b>{escape(type(self).__name__)}</b>{table(self._summary())}"


def table(rows: Iterable[Iterable[Any]], titles: Sequence[str] = ()) -> str:
    """An HTML table; everything in it is text."""
    head = "".join(f"<th>{escape(title)}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(x))}</td>" for x in row) + "</tr>" for row in rows)
    return f"<table>{f'<tr>{head}</tr>' if head else ''}{body}</table>"


def plural(n: int, what: str) -> str:
    """Return a number of things in words: `no starts`, `1 start`, `8 starts`."""
    return f"{n or 'no'} {what}{'s' * (n != 1)}"


def few(names: Sequence[Any], most: int = 6) -> str:
    """The first of several names, and how many more there are."""
    shown = ", ".join(map(str, names[:most]))
    return f"{shown}, ... ({len(names)} in all)" if len(names) > most else shown or "none"
