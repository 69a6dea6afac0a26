"""The blocks of code in the pages of the documentation.

tests/page_blocks.py runs the blocks, notebooks.py makes cells of them.
"""

from __future__ import annotations

import re

from experiments.documentation.generated import MARK

FENCE = re.compile(
    r'^(?P<comment><!-- not run: .+? -->\n)?```(?P<language>\w+)(?: title="(?P<title>[^"]+)")?\n(?P<text>.*?)^```$',
    re.DOTALL | re.MULTILINE,
)


def runnable(text: str) -> str:
    """A page with empty lines for its generated parts: tests/test_docstrings.py runs their examples. Inserted files stay."""
    return MARK.sub(lambda mark: mark[0] if mark["part"] == "file" else "\n" * mark[0].count("\n"), text)
