"""The notebooks of the tutorials: they are current, have the code that tests/test_docs.py runs, and run as notebooks do."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from experiments.documentation import notebooks
from tests.page_blocks import Block, blocks

PAGES = notebooks.pages()
QUICK = ("antenna",)


def cells(page: Path) -> list[str]:
    """Code cells as they are stored."""
    stored = json.loads(page.with_suffix(".ipynb").read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in stored["cells"] if cell["cell_type"] == "code"]


def code(block: Block) -> str:
    if block.title:
        return f"%%writefile {block.title}\n{block.text}"
    return "".join(notebooks.sources(block.text)) if block.language == "pycon" else block.text


def lines(texts: list[str]) -> list[str]:
    return [line for text in texts for line in text.splitlines() if line]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_notebook_is_its_page(page):
    command = "python -m experiments.documentation.notebooks"
    assert page.with_suffix(".ipynb").read_text(encoding="utf-8") == notebooks.written(page), f"run {command}"
    assert f"]({page.stem}.ipynb)" in page.read_text(encoding="utf-8")
    tested = [b for b in blocks(page) if not b.left_out and (b.title or b.language in ("python", "pycon"))]
    assert lines(cells(page)[1:]) == lines([code(block) for block in tested])


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.stem, marks=[] if p.stem in QUICK else [pytest.mark.slow]) for p in PAGES]
)
@pytest.mark.filterwarnings("ignore")
def test_a_notebook_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    before, path = set(sys.modules), list(sys.path)
    names = {"__name__": "__main__"}
    for cell in cells(page):
        if cell.startswith("%%writefile "):
            first, _, text = cell.partition("\n")
            Path(first.split()[1]).write_text(text, encoding="utf-8")
        else:
            exec(compile(cell, page.stem, "exec"), names)
    sys.path[:] = path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


def test_a_session_becomes_cells():
    assert notebooks.sources(">>> a = 1\n>>> a\n1\n>>> b = 2\n") == ["a = 1\na\n", "b = 2\n"]
