"""Hooks of mkdocs: equations become MathML."""

from __future__ import annotations

import re
from html import unescape
from typing import Any

_MATH = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)


def on_page_content(html: str, **_: Any) -> str:
    """Write equations as MathML: no script draws them, none is fetched."""
    return _MATH.sub(_mathml, html)


def _mathml(match: re.Match[str]) -> str:
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]

    text = unescape(match[2]).strip().removeprefix("\\(").removeprefix("\\[")[:-2]
    if match[1] == "span":
        return convert(text, display="inline")
    return f'<div class="equation">{convert(text, display="block")}</div>'
