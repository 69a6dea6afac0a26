"""Every page of the documentation is run as it stands there; pages that say `slow: true` on top, with -m slow."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import torchmbd
from experiments.documentation import links
from tests.page_blocks import blocks, commands, run
from torchmbd import cli

ROOT = Path(__file__).parents[1]
LONG = {"docs/how-to/lamination_parameters.md", "docs/how-to/exact_beams.md"}  # seconds of processor time
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"pycon", "python", "yaml", "sh", "text", "html"}


def _named(page: Path) -> str:
    return str(page.relative_to(ROOT))


def _marked(page: Path):
    slow = page.read_text(encoding="utf-8").startswith("---\nslow: true\n")
    long = [pytest.mark.thorough] if _named(page) in LONG else []
    return pytest.param(page, id=_named(page), marks=[pytest.mark.slow] if slow else long)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "page", [_marked(p) for p in PAGES if {"pycon", "python", "yaml"} & {b.language for b in blocks(p)}]
)
def test_page(page, tmp_path, monkeypatch, compiled):
    """By native code, as users run it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / ".torchmbd"))
    before = set(sys.modules)
    run(page, tmp_path)
    for name in set(sys.modules) - before:  # modules that the page has written, not those of packages
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.mark.parametrize("page", PAGES, ids=_named)
def test_blocks_have_languages_and_commands_exist(page):
    text = page.read_text(encoding="utf-8")
    assert text.count("\n```") % 2 == 0
    for block in blocks(page):
        assert block.language in LANGUAGES, f"{page.name}, line {block.line}: {block.language}"
    for module in re.findall(r"python -m ((?:experiments|tests)[\w.]*)", text):
        assert importlib.util.find_spec(module) is not None, f"{page.name}: {module}"
    for line in commands(page):
        assert line[0] in [name for name in cli.app if not name.startswith("-")], f"{page.name}: torchmbd {line[0]}"


@pytest.mark.parametrize("page", PAGES, ids=_named)
def test_links_and_pictures_are_there(page):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (page.parent / target).exists(), f"{page.name}: {target}"


def test_pages_are_in_the_navigation():
    listed = re.findall(r"(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(str(p.relative_to(ROOT / "docs")) for p in PAGES[1:])


@pytest.mark.thorough
def test_the_site_is_built_without_a_warning_and_its_links_lead_somewhere(tmp_path):
    pytest.importorskip("mkdocs", reason="needs mkdocs: pip install -e '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = links.read(tmp_path / "site")
    docs = ROOT / "docs"
    assert {(tmp_path / "site" / p.relative_to(docs)).with_suffix(".html").resolve() for p in PAGES[1:]} <= set(pages)
    assert links.broken(pages, tmp_path / "site") == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_bytes()) <= 6_000


def test_the_citation_names_this_version_and_no_person_as_author():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["title"], str(citation["version"])) == ("torchmbd", torchmbd.__version__)
    assert [set(author) for author in citation["authors"]] == [{"name"}]  # persons have family-names
    (paper,) = citation["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Ambrósio", "Neto", "Leal"]


def test_the_file_of_the_how_to_page_is_the_shipped_one():
    first, *_ = [b.text for b in blocks(ROOT / "docs" / "how-to" / "files.md") if b.language == "yaml"]
    assert first == (ROOT / "configs/slider_crank/l3_energy_integral.yaml").read_text(encoding="utf-8")
