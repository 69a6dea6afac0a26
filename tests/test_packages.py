"""Every package that torchmbd imports is declared, and installed for the tests: none of them is left out for want of one."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.conftest import SECOND_TIER

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Modules whose distribution has another name, or that belong to another distribution's interface.
DISTRIBUTION = {
    "yaml": "pyyaml",
    "mpl_toolkits": "matplotlib",
    "pydantic_core": "pydantic",
    "annotated_types": "annotated-types",
    "dask": "distributed",
    "psutil": "distributed",  # which needs it
}
ELSEWHERE = {"cyipopt"}  # no wheel: by conda only, as its method says


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[^\w.-]", text)[0].lower().replace("_", "-") for text in requirements}


def imported(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
        elif isinstance(node, ast.Call) and "import_module" in ast.dump(node.func):
            yield from (word.value for word in node.args if isinstance(word, ast.Constant))


@cache
def packages() -> set[str]:
    modules = {name.partition(".")[0] for file in (ROOT / "torchmbd").rglob("*.py") for name in imported(file)}
    foreign = modules - set(sys.stdlib_module_names) - {"torchmbd"} - ELSEWHERE
    return {DISTRIBUTION.get(name, name).replace("_", "-") for name in foreign}


@pytest.mark.thorough
def test_packages_are_declared():
    extras = [line for extra, lines in PROJECT["optional-dependencies"].items() if extra != "test" for line in lines]
    assert {"torch", "nlopt", "dask-jobqueue"} <= packages()
    assert packages() <= names([*PROJECT["dependencies"], *extras])


@pytest.mark.thorough
def test_the_tests_have_them_all():
    assert packages() <= names([*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["test"]])


def test_what_is_declared_is_imported():
    assert names(PROJECT["dependencies"]) <= packages()


def test_every_folder_of_tests_is_of_a_tier():
    tests = ROOT / "tests"
    folders = {path.name for path in tests.iterdir() if any(path.glob("**/test_*.py"))}
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert {f"tests/{name}" for name in folders - SECOND_TIER - {"extensions"}} | {"tests/test_*.py"} == set(
        options["testpaths"]
    )
    assert folders > SECOND_TIER | {"extensions"}
    assert "pytest -n 2 tests/extensions\n" in (ROOT / ".ci" / "run").read_text()
