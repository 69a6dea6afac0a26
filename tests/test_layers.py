"""Who may import whom, and what module headers promise.

A floor knows the floors below it, never one above or beside it.

Imports for type annotations only (`if TYPE_CHECKING:`) are no dependence at run time and are left out.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "torchmbd"
# From the ground up; folders of one line do not know each other.
FLOORS = (
    {"errors", "process"},
    {"numerics"},
    {"mesh", "materials"},
    {"elements", "sections"},
    {"reduction"},
    {"bodies"},
    {"joints"},
    {"forces"},
    {"system"},
    {"integrators"},
    {"optimizers"},
    {"design"},
    {"viz", "tracking"},
    {"experiment"},
    {"public", "cli"},
)
HEIGHT = {name: height for height, names in enumerate(FLOORS) for name in names}
# Narrower than their height: modes are those of any K and M, optimizers know arrays only.
ONLY = {"reduction": {"errors", "numerics"}, "optimizers": {"errors", "process"}}
FILES = sorted(file for file in PACKAGE.rglob("*.py") if file != PACKAGE / "__init__.py")


def floor(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(file: Path) -> Iterator[str]:
    """Names torchmbd.<floor>... that a file imports at run time; relative imports made absolute."""
    package = ("torchmbd", *file.relative_to(PACKAGE).parts[:-1])

    def visit(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            return
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*start, *([node.module] if node.module else [])])
            yield from (f"{module}.{alias.name}" for alias in node.names)
        for child in ast.iter_child_nodes(node):
            yield from visit(child)

    return (name for name in visit(ast.parse(file.read_text())) if name.split(".")[0] == "torchmbd")


def test_every_folder_has_its_floor():
    assert {floor(file) for file in FILES} == set(HEIGHT)


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_nobody_imports_upwards(file):
    own = floor(file)
    for name in imported(file):
        parts = name.split(".")
        if len(parts) < 2 or parts[1] not in HEIGHT:  # the whole package, or a name that it re-exports
            assert own in ("experiment", "cli"), f"{name} stands for all floors"
            continue
        other = parts[1]
        allowed = ONLY.get(own) or {below for below, height in HEIGHT.items() if height < HEIGHT[own]}
        assert other == own or other in allowed, f"{own} imports {name}"


def test_an_upward_import_is_seen(tmp_path):
    """The test can fail: relative, absolute, inside a function; not under TYPE_CHECKING."""
    file = PACKAGE / "bodies" / "frame.py"
    source = (
        "from typing import TYPE_CHECKING\nfrom ..system import System\nimport torchmbd.design.space\n"
        "if TYPE_CHECKING:\n    from torchmbd.viz import animate\ndef f():\n    from .. import joints\n"
    )

    class Fake(type(file)):
        def read_text(self, *args, **kwargs):
            return source

    assert list(imported(Fake(file))) == [
        "torchmbd.multibody.system.System",
        "torchmbd.design.space",
        "torchmbd.multibody.joints",
    ]


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_no_file_is_long(file):
    assert len(file.read_text().splitlines()) <= 400


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_the_tests_that_a_header_names_exist(file):
    """A header says where its claims are checked: a name that leads nowhere is a claim that nobody checks."""
    for name in re.findall(r"tests/[\w/]+\.py", file.read_text()):
        assert (PACKAGE.parent / name).exists(), name
