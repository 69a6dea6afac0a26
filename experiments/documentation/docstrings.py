"""Docstrings as the reference shows them: the first sentence as text, the rest with its columns, examples as code."""

from __future__ import annotations

import inspect
from itertools import groupby
from typing import Any

import griffe  # pyright: ignore[reportMissingImports]


class Columns(griffe.Extension):
    """Our docstrings explain arguments in aligned columns, which Markdown would run together."""

    def on_instance(self, *, obj: Any, **_: Any) -> None:
        """Rewrite the docstring of every object that is loaded."""
        if obj.docstring is not None and not obj.is_alias:
            obj.docstring.value = verbatim_columns(obj.docstring.value)


def verbatim_columns(docstring: str) -> str:
    """The first paragraph, then the rest as blocks of text and of examples."""
    first, _, rest = inspect.cleandoc(docstring).partition("\n\n")
    if "\n" in first:
        first, rest = "", f"{first}\n\n{rest}".rstrip()
    parts = [first.replace("[", "&#91;")] if first else []  # shapes and units, no links
    for language, paragraphs in groupby(rest.split("\n\n") if rest.strip() else [], _language):
        text = "\n\n".join(paragraphs).strip("\n")
        parts.append(f"```{language}\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _language(paragraph: str) -> str:
    return "pycon" if paragraph.startswith(">>> ") else "text"
