"""The blocks of a page of the documentation, run in their order in one namespace and one folder.

    ```pycon                      a session: what stands there is typed and compared
    ```python                     executed
    ```python title="arm.py"      written to that file, as is every block with a title; a program may import it
    ```yaml title="arm.yaml"      written; checked as an experiment file where it says `model:`
    ```yaml                       read as an experiment file where it says `model:`
    ```sh                         lines `torchmbd ...` are run by `commands`, with the overrides of the test

Other languages are not run. `<!-- not run: why -->` above a block leaves it out, and says why.
"""

from __future__ import annotations

import doctest
import re
from pathlib import Path
from typing import Any, NamedTuple

from experiments.documentation.blocks import FENCE, runnable
from torchmbd import cli
from torchmbd.study.file.load import load


class Block(NamedTuple):
    """A block of a page: line is where its text begins, title the file that it is written to."""

    language: str
    title: str | None
    text: str
    line: int
    left_out: bool


def blocks(page: Path) -> list[Block]:
    """All blocks of a page."""
    text = runnable(page.read_text(encoding="utf-8"))
    return [
        Block(m["language"], m["title"], m["text"], text.count("\n", 0, m.start("text")), m["comment"] is not None)
        for m in FENCE.finditer(text)
    ]


def run(page: Path, folder: Path) -> dict[str, Any]:
    """Run what Python there is, and check the experiment files; returns the names that the page has defined."""
    names: dict[str, Any] = {"__name__": "__main__"}  # dataclasses ask for their module
    for block in blocks(page):
        if block.left_out:
            continue
        if block.title:
            (folder / block.title).write_text(block.text, encoding="utf-8")
            if block.language == "yaml" and re.search("^model:", block.text, re.MULTILINE):
                assert cli.main(["check", str(folder / block.title)]) == 0, f"{page.name}, line {block.line}"
        elif block.language == "yaml" and re.search("^model:", block.text, re.MULTILINE):
            (folder / "experiment.yaml").write_text(block.text, encoding="utf-8")
            load(folder / "experiment.yaml")
        elif block.language == "python":
            exec(compile("\n" * block.line + block.text, str(page), "exec"), names)
        elif block.language == "pycon":
            _session(page, block, names)
    return names


def _session(page: Path, block: Block, names: dict[str, Any]) -> None:
    test = doctest.DocTestParser().get_doctest(block.text, names, page.name, str(page), block.line)
    test.globs = names  # a copy otherwise: the next block goes on with them
    report: list[str] = []
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    doctest.DocTestRunner(optionflags=flags).run(test, out=report.append, clear_globs=False)
    assert not report, "".join(report)


def commands(page: Path, program: str = "torchmbd") -> list[list[str]]:
    """Arguments of all lines of shell blocks that call the program."""
    lines = [line for b in blocks(page) if b.language == "sh" and not b.left_out for line in b.text.splitlines()]
    return [line.partition("#")[0].split()[1:] for line in lines if line.startswith(f"{program} ")]
