"""Parts of pages that come from the program: `python -m experiments.documentation.generated` renews them.

    <!-- generated: commands -->            what PARTS["commands"] returns stands below, up to <!-- end -->
    <!-- generated: group joints -->        with an argument
    <!-- generated: file some/file.py -->   a file of the repository, as a block with its name

The text is the same on every machine. Checked in tests/experiments/test_documentation.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from experiments.documentation import reference

DOCS = Path(__file__).parents[2] / "docs"
PARTS: dict[str, Callable[..., str]] = {
    "commands": reference.commands,
    "experiments": reference.experiments,
    "file": reference.file,
    "file_keys": reference.file_keys,
    "first_file": reference.first_file,
    "group": reference.group,
}
MARK = re.compile(r"<!-- generated: (?P<part>\w+)(?: (?P<argument>\S+))? -->\n(?P<text>.*?)<!-- end -->", re.DOTALL)


def renewed(text: str) -> str:
    """The text of a page with its generated parts made anew."""

    def made(mark: re.Match[str]) -> str:
        part = PARTS[mark["part"]](*filter(None, [mark["argument"]]))
        return f"{mark[0].partition(chr(10))[0]}\n{part.strip(chr(10))}\n<!-- end -->"

    return MARK.sub(made, text)


def main() -> None:
    for page in sorted(DOCS.rglob("*.md")):
        old = page.read_text(encoding="utf-8")
        new = renewed(old)
        if new != old:
            page.write_text(new, encoding="utf-8")
            print(page.relative_to(DOCS.parent))


if __name__ == "__main__":
    main()
