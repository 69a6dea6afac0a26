"""Hooks of mkdocs: generated parts are put into their pages, equations become MathML.

<!-- insert: commands -->          the Markdown that INSERTS["commands"] returns
<!-- insert: experiments -->       a table of the files in configs/
<!-- insert: group joints -->      the same with an argument
<!-- insert: file some/file.py -->  a file of the repository, as a block with its name
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from html import unescape
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))  # mkdocs loads this file by its path

from experiments.documentation import reference

INSERTS: dict[str, Callable[..., str]] = {
    "commands": reference.commands,
    "experiments": reference.experiments,
    "file": reference.file,
    "file_keys": reference.file_keys,
    "first_file": reference.first_file,
    "group": reference.group,
}
_MARK = re.compile(r"<!-- insert: (\w+)(?: (\S+))? -->")
_MATH = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put generated parts where the page asks for them."""
    return _MARK.sub(lambda mark: INSERTS[mark[1]](*filter(None, [mark[2]])), markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Write equations as MathML: no script draws them, none is fetched."""
    return _MATH.sub(_mathml, html)


def _mathml(match: re.Match[str]) -> str:
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]

    text = unescape(match[2]).strip().removeprefix("\\(").removeprefix("\\[")[:-2]
    if match[1] == "span":
        return convert(text, display="inline")
    return f'<div class="equation">{convert(text, display="block")}</div>'
