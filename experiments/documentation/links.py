"""Follow every link of the built site: `python -m experiments.documentation.links [FOLDER] [--external]`

Pages, anchors, pictures, scripts and downloads inside the site must exist; the exit code is 1 where one does not.
--external prints the links that lead out of the site, with the number of pages that have them.
Checked in tests/experiments/test_links.py.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit


class Link(NamedTuple):
    """A link of a page, as it is written there."""

    page: Path
    target: str


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = {"", "__top"}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, text in attrs:
            if name in ("href", "src") and text:
                self.targets.append(text)
            if name == "id" or (tag == "a" and name == "name"):
                self.anchors.add(text or "")


def read(folder: Path) -> dict[Path, _Page]:
    """All pages of a site."""
    pages = {}
    for file in sorted(folder.rglob("*.html")):
        pages[file.resolve()] = page = _Page()
        page.feed(file.read_text(encoding="utf-8"))
    return pages


def _links(pages: dict[Path, _Page]) -> Iterator[Link]:
    for file, page in pages.items():
        for target in page.targets:
            yield Link(file, target)


def external(pages: dict[Path, _Page]) -> Counter[str]:
    """Links that lead out of the site, with the number of pages that have them."""
    return Counter(target for _, target in set(_links(pages)) if urlsplit(target).scheme in ("http", "https"))


def broken(pages: dict[Path, _Page], folder: Path) -> list[Link]:
    """Links inside the site that lead nowhere; those that begin with a slash begin at its folder."""
    dead = []
    for link in sorted(set(_links(pages))):
        parts = urlsplit(link.target)
        if parts.scheme or parts.netloc:
            continue
        path = unquote(parts.path)
        start = folder / path.lstrip("/") if path.startswith("/") else link.page.parent / path
        file = start.resolve() if path else link.page
        file = file / "index.html" if file.is_dir() else file
        known = unquote(parts.fragment) in pages[file].anchors if file in pages else not parts.fragment
        if not file.exists() or not known:
            dead.append(link)
    return dead


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path("site"))
    parser.add_argument("--external", action="store_true", help="print the links that lead out of the site")
    arguments = parser.parse_args()
    pages = read(arguments.folder)
    if arguments.external:
        for target, count in external(pages).most_common():
            print(f"{count:4d}  {target}")
    bad = broken(pages, arguments.folder)
    for link in bad:
        print(f"{link.page.relative_to(arguments.folder.resolve())}: {link.target}")
    print(f"{len(pages)} pages, {sum(len(page.targets) for page in pages.values())} links, {len(bad)} broken")
    sys.exit(bool(bad) or not pages)


if __name__ == "__main__":
    main()
