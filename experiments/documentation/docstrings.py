"""Docstrings as the reference shows them: the first sentence as text, the rest as it stands, with its columns."""

from __future__ import annotations

import inspect
from typing import Any

import griffe  # pyright: ignore[reportMissingImports]


class Columns(griffe.Extension):
    """Our docstrings explain arguments in aligned columns, which Markdown would run together."""

    def on_instance(self, *, obj: Any, **_: Any) -> None:
        """Rewrite the docstring of every object that is loaded."""
        if obj.docstring is not None and not obj.is_alias:
            obj.docstring.value = verbatim_columns(obj.docstring.value)


def verbatim_columns(docstring: str) -> str:
    """The first paragraph, then the rest as a block of text."""
    first, _, rest = inspect.cleandoc(docstring).partition("\n\n")
    lines = first.splitlines()
    sentence = f"{lines[0]}\n" if len(lines) == 1 else ""
    block = rest if sentence else f"{first}\n\n{rest}".rstrip()
    return f"{sentence}\n```text\n{block}\n```\n" if block.strip() else sentence
