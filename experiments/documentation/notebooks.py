"""The tutorials as Jupyter notebooks: `python -m experiments.documentation.notebooks` writes them beside their pages.

A block of Python of the page becomes a code cell, a session one or more cells without the printed results, a file a cell
`%%writefile`. Text, shell commands and blocks that are not run become text. Cells have no outputs.
Checked in tests/experiments/test_notebooks.py.
"""

from __future__ import annotations

import doctest
import json
import os
import re
from pathlib import Path
from typing import Any

from experiments.documentation.blocks import FENCE
from experiments.documentation.generated import MARK

DOCS = Path(__file__).parents[2] / "docs"
FOLDER = DOCS / "tutorials"
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?://)([^)#\s]*)(#[^)\s]*)?\)")
_FIRST = """\
import os
import sys

os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported: two threads are slower here
sys.path.insert(0, "../..")  # the folder of the repository, where the package experiments is"""


def pages() -> list[Path]:
    """The pages that have a notebook."""
    return [page for page in sorted(FOLDER.glob("*.md")) if page.name != "index.md"]


def notebook(page: Path) -> dict[str, Any]:
    """The notebook of a page, as a mapping that JSON holds."""
    text = MARK.sub(lambda mark: mark["text"], page.read_text(encoding="utf-8"))
    text = re.sub(r"\A---\n.*?^---\n", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^\[[^\]]+\]\(\w+\.ipynb\).*\n\n", "", text, flags=re.MULTILINE)
    cells: list[tuple[str, str]] = []
    at = 0
    for block in FENCE.finditer(text):
        code = _code(block)
        if code:
            cells += [
                ("markdown", _plain(text[at : block.start()], page)),
                *(("code", cell) for cell in code),
            ]
            at = block.end()
    cells.append(("markdown", _plain(text[at:], page)))
    cells.insert(1, ("code", _FIRST))
    cells = [(kind, source.strip("\n")) for kind, source in cells if source.strip()]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {
        "cells": [_cell(number, *cell) for number, cell in enumerate(cells)],
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def _code(block: re.Match[str]) -> list[str]:
    """Code cells of a block; none: it stays text."""
    if block["comment"]:
        return []
    if block["title"]:
        return [f"%%writefile {block['title']}\n{block['text']}"]
    if block["language"] == "python":
        return [block["text"]]
    return sources(block["text"]) if block["language"] == "pycon" else []


def sources(session: str) -> list[str]:
    """What is typed in a session, a cell up to each printed result."""
    pieces, rest = [], ""
    for example in doctest.DocTestParser().get_examples(session):
        rest += example.source
        if example.want:
            pieces.append(rest)
            rest = ""
    return [*pieces, rest] if rest else pieces


def _plain(text: str, page: Path) -> str:
    """Text whose links to other pages say which file of the repository they mean."""

    def said(link: re.Match[str]) -> str:
        path = Path(os.path.normpath(page.parent / link[2])).relative_to(DOCS.parent)
        return f"{link[1]} (`{path}`)"

    return _LINK.sub(said, text)


def _cell(number: int, kind: str, source: str) -> dict[str, Any]:
    cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
    cell["source"] = source.splitlines(keepends=True)
    return cell | ({"execution_count": None, "outputs": []} if kind == "code" else {})


def written(page: Path) -> str:
    """The file of a page's notebook."""
    return json.dumps(notebook(page), indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    for page in pages():
        file = page.with_suffix(".ipynb")
        file.write_text(written(page), encoding="utf-8")
        print(f"{file} {file.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
