"""The answer of a study: a table of the responses of start and best design with their errors, limits and margins.

The commands that read it from the store need no torch.
Checked in tests/study/test_verification.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape as plain
from rich.table import Table

from torchmbd.results.answer import Answer, Verification
from torchmbd.tracking.catalog import Entry, fetch
from torchmbd.tracking.uri import StoreURI

ANSWER = "answer.json"  # file of a run
_HEADINGS = ("", "response", "start", "best", "limit", "margin")


def stored_verification(store: StoreURI, entry: Entry, folder: Path) -> Verification | None:
    """Return the verification of a run; None if it has none. `folder` takes a copy of the file."""
    file = fetch(store, entry, ANSWER, folder)
    return None if file is None else Verification.from_json(file.read_text(encoding="utf-8"))


def print_answers(verification: Verification, console: Console) -> None:
    """Print the table, and whether the best design is verified."""
    if verification.answers:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for heading in _HEADINGS:
            table.add_column(heading, justify="left" if heading in _HEADINGS[:2] else "right", overflow="fold")
        for cells in _rows(verification.answers):
            table.add_row(*map(plain, cells))
        console.print(table)
    style = None if verification.verified else "red"
    for text in (verification.status, *(f"({note})" for note in verification.notes)):
        console.print(plain(text), style=style, soft_wrap=True, highlight=False)
        style = None


def answers_page(verification: Verification) -> str:
    """Return the table as HTML, with whether the best design is verified; everything in it is text."""
    head = "".join(f"<th>{escape(heading)}</th>" for heading in _HEADINGS)
    rows = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>" for cells in _rows(verification.answers)
    )
    status = "quiet" if verification.verified else "warning"
    notes = "".join(f'<p class="quiet">{escape(note)}</p>' for note in verification.notes)
    return f'<p class="{status}">{escape(verification.status)}</p><table><tr>{head}</tr>{rows}</table>{notes}'


def comparison(first: Verification | None, second: Verification | None) -> list[tuple[str, str, str]]:
    """Return what two best designs answer: response, of the first, of the second; "-" where one has none."""
    columns = [
        {} if side is None else {f"{row.goal} {row.heading}".strip(): str(row.best) for row in side.answers}
        for side in (first, second)
    ]
    names = dict.fromkeys(name for column in columns for name in column)
    return [(name, *(column.get(name, "-") for column in columns)) for name in names]  # type: ignore[misc]


def _rows(answers: Sequence[Answer]) -> list[list[str]]:
    return [
        [
            answer.goal,
            answer.heading,
            str(answer.start),
            str(answer.best),
            "" if answer.limit is None else f"{answer.limit:.6g}",
            answer.margin_text,
        ]
        for answer in answers
    ]
