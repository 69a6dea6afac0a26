"""The blocks of code in the pages of the documentation, and files that pages insert.

tests/page_blocks.py runs the blocks, notebooks.py makes cells of them.
"""

from __future__ import annotations

import re

from experiments.documentation.reference import file

FENCE = re.compile(
    r'^(?P<comment><!-- not run: .+? -->\n)?```(?P<language>\w+)(?: title="(?P<title>[^"]+)")?\n(?P<text>.*?)^```$',
    re.DOTALL | re.MULTILINE,
)
_INSERTED = re.compile(r"<!-- insert: file (\S+) -->")


def inserted(text: str) -> str:
    """The text of a page with the files that it inserts."""
    return _INSERTED.sub(lambda mark: file(mark[1]), text)
