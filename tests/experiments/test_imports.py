"""Modules of experiments/: who imports whom, and that the commands which docstrings of folders name are there."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.test_layers import circles

ROOT = Path(__file__).parents[2]
EXPERIMENTS = ROOT / "experiments"
FOLDERS = ("models", "peers", "paper", "benchmark", "tutorial", "documentation")  # each imports those before it
MODULES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted(EXPERIMENTS.rglob("*.py"))
}


def imported(text: str) -> Iterator[str]:
    """Modules of experiments, or names in them, that a text imports anywhere, in functions too."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] == "experiments")


GRAPH = {
    name: {x if x in MODULES else x.rpartition(".")[0] for x in imported(file.read_text(encoding="utf-8"))}
    for name, file in MODULES.items()
}


def test_imports_lead_to_modules():
    assert {name: wrong for name, named in GRAPH.items() if (wrong := named - set(MODULES))} == {}


def test_no_modules_import_each_other_in_a_circle():
    assert circles(GRAPH) == []


def test_a_folder_imports_those_before_it():
    def height(name: str) -> int:
        return FOLDERS.index(name.split(".")[1])

    wrong = {name: [x for x in named if height(x) > height(name)] for name, named in GRAPH.items() if "." in name}
    assert {name: result for name, result in wrong.items() if result} == {}


def test_every_file_is_in_a_folder():
    assert [file.name for file in EXPERIMENTS.iterdir() if file.is_file()] == ["__init__.py"]
    assert {file.parent.name for file in EXPERIMENTS.glob("*/__init__.py")} == set(FOLDERS)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_says_what_it_has_and_how_it_runs(folder):
    said = ast.get_docstring(ast.parse((EXPERIMENTS / folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    commands = re.findall(r"`(?:python -m |torchmbd )([^`]+)`", said)
    assert commands
    for command in commands:
        word, *more = command.split()
        if word.startswith("experiments."):
            assert importlib.util.find_spec(word) is not None, command
        else:
            assert (ROOT / more[0]).exists(), command
    files = {file.stem for file in (EXPERIMENTS / folder).iterdir() if file.suffix in (".py", ".yaml")}
    assert files - set(re.findall(r"\w+", said)) <= {"__init__", "__main__"}


TEXTS = [
    file
    for pattern in ("*.py", "*.md", "*.ipynb", "*.y*ml", "*.toml", "*.json", "README*", ".ci/*")
    for file in ROOT.rglob(pattern)
    if file.is_file()
    and not {"site", ".venv", "build"} & set(file.relative_to(ROOT).parts)
    and file
    != ROOT
    / "tests/extensions/identification/test_files.py"  # keys of the section `identify` begin with `experiments.`
]
# #/experiments/ are pages of MLflow; experiments of an identification are lists and mappings.
NAME = re.compile(r"(?<![\w/#])experiments[./](?!__|(?:append|items|values)\b)(\w+)(?:[./](\w+))?")


def test_every_name_of_a_module_or_file_here_leads_somewhere():
    """In pages, notebooks, experiment files, docstrings and tests: a move leaves no name of the former place."""
    lost = [
        f"{file.relative_to(ROOT)}: experiments.{folder}.{name}"
        for file in TEXTS
        for folder, name in NAME.findall(file.read_text(encoding="utf-8"))
        if not (EXPERIMENTS / folder).is_dir() or (name and not list((EXPERIMENTS / folder).glob(f"{name}*")))
    ]
    assert lost == []
