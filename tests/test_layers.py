"""Which package may import which, that no modules import each other in a circle, and what module headers promise."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchmbd as mbd

PACKAGE = Path(__file__).parents[1] / "torchmbd"
# From the ground up; packages of one line do not import each other.
LAYERS = (
    {"errors"},
    {"process", "progress", "summary", "registry", "fixed_arguments"},
    {"math", "viz.figures"},
    {"fem.mesh", "fem.materials", "fem.shape_functions"},
    {"fem.elements", "fem.sections"},
    {"fem.reduction"},
    {"fem.exact_beam"},
    {"multibody.bodies"},
    {"multibody.joints", "multibody.statics"},
    {"multibody.forces"},
    {"multibody.equations"},
    {"multibody.saddle"},
    {"multibody.equilibrium"},
    {"multibody.start"},
    {"multibody.system"},
    {"results"},
    {"integrate"},
    {"diagnosis"},
    {"simulation"},
    {"optimization"},
    {"design"},
    {"viz", "tracking", "examples", "io"},
    {"extensions.beamdyn", "extensions.fatigue", "extensions.fibers", "extensions.nastran", "extensions.ply_book"},
    {"extensions.native"},
    {
        "extensions.lamination",
        "extensions.matrices",
        "extensions.meshes",
        "extensions.openmdao",
        "extensions.robots",
        "extensions.shell_models",
        "extensions.windio",
    },
    {"extensions.buckling", "extensions.paraview", "extensions.vibrations"},
    {"study"},
    {"extensions.identification"},
    {"api", "cli"},
    {"__main__"},
)
HEIGHT = {name: height for height, names in enumerate(LAYERS) for name in names}
# Narrower than their layer: modes are those of any K and M, optimizers know arrays only.
ONLY = {
    "fem.reduction": {"errors", "math"},
    "optimization": {"errors", "process", "progress", "summary", "fixed_arguments", "viz.figures"},
}
EMPTY = {"torchmbd.fem", "torchmbd.multibody", "torchmbd.extensions"}  # packages of packages: they import nothing
FILES = sorted(file for file in PACKAGE.rglob("*.py") if file != PACKAGE / "__init__.py")


def module(file: Path) -> str:
    return ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module(file): file for file in FILES}


def package(name: str) -> str | None:
    """The package of HEIGHT that a module or a name in it belongs to."""
    parts = name.split(".")[1:3]
    return next((result for k in (2, 1) if (result := ".".join(parts[:k])) in HEIGHT), None)


def imports(text: str, name: str, typing: bool) -> Iterator[str]:
    """Modules of torchmbd, or names in them, that a text imports; with those under TYPE_CHECKING if `typing`."""
    own = name.split(".")[:-1]

    def visit(node: ast.AST) -> Iterator[str]:
        if not typing and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            return
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            start = own[: len(own) - node.level + 1] if node.level else []
            yield from (".".join([*start, *([node.module] if node.module else []), alias.name]) for alias in node.names)
        for child in ast.iter_child_nodes(node):
            yield from visit(child)

    return (result for result in visit(ast.parse(text)) if result.split(".")[0] == "torchmbd")


def upward(text: str, name: str) -> list[str]:
    """Imports that no layer allows."""
    own, wrong = package(name), []
    for result in imports(text, name, typing=False):
        other = package(result)
        if other is None:  # the whole package, or a name that it re-exports
            wrong += [result] if own not in ("study", "cli") else []
        elif other != own and not (other in ONLY[own] if own in ONLY else HEIGHT[other] < HEIGHT[own or ""]):
            wrong.append(result)
    return wrong


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    path: list[str] = []
    result = []

    def connect(v: str) -> None:
        index[v] = low[v] = len(index)
        path.append(v)
        for w in graph[v]:
            if w not in index:
                connect(w)
                low[v] = min(low[v], low[w])
            elif w in path:
                low[v] = min(low[v], index[w])
        if low[v] == index[v]:
            start = path.index(v)
            if len(path) - start > 1:
                result.append(sorted(path[start:]))
            del path[start:]

    for v in graph:
        if v not in index:
            connect(v)
    return result


def test_every_module_has_its_layer():
    assert [name for name in MODULES if package(name) is None and name not in EMPTY] == []


@pytest.mark.thorough
def test_nobody_imports_upwards():
    assert {name: wrong for name, file in MODULES.items() if (wrong := upward(file.read_text(), name))} == {}


def import_graph() -> dict[str, set[str]]:
    """The modules that each module imports."""
    graph = {}
    for name, file in MODULES.items():
        named = {x if x in MODULES else x.rpartition(".")[0] for x in imports(file.read_text(), name, typing=True)}
        graph[name] = named & set(MODULES)
    return graph


@pytest.mark.thorough
def test_no_modules_import_each_other_in_a_circle():
    """Imports for annotations included."""
    assert circles(import_graph()) == []


@pytest.mark.thorough
def test_phases_import_nothing_that_imports_them():
    """The loop through segments and its adjoint know steps, and nothing of who calls them."""
    graph, phases = import_graph(), "torchmbd.integrate.phases"

    def reached(name: str, seen: set[str]) -> set[str]:
        for other in graph[name] - seen:
            seen.add(other)
            reached(other, seen)
        return seen

    members = {name for name in graph if name.startswith(f"{phases}.")}
    used = {name for member in members for name in graph[member]} - members
    assert {name for name in used if reached(name, set()) & members} == set()
    assert members
    assert used


def extension_names(text: str) -> list[str]:
    """Imports of extensions, at the top, in functions or for type checkers, and texts that name them, in a text of the core."""
    words = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant)]
    named = [word for word in words if isinstance(word, str) and re.fullmatch(r"torchmbd\.extensions[\w.:]*", word)]
    return [*(x for x in imports(text, "torchmbd.x", typing=True) if x.split(".")[1:2] == ["extensions"]), *named]


def test_the_core_imports_no_extension():
    """torchmbd/__init__.py and torchmbd/io.py have the names for type checkers, registry.py finds them."""
    core = [PACKAGE / "__init__.py", *(file for file in FILES if PACKAGE / "extensions" not in file.parents)]
    result = {module(file): names for file in core if (names := extension_names(file.read_text()))}
    assert result.pop("torchmbd.io")
    assert result == {"torchmbd": ["torchmbd.extensions.*"], "torchmbd.registry": ["torchmbd.extensions"]}


@pytest.mark.extensions
def test_the_room_of_files_has_the_readers_that_type_checkers_see():
    readers = extension_names((PACKAGE / "io.py").read_text())
    assert all(name.rpartition(".")[2] in dir(mbd.io) for name in readers)


def test_an_import_of_an_extension_is_seen():
    text = (
        "import torchmbd.extensions.a\ndef f():\n    from torchmbd.extensions import a\n    g('torchmbd.extensions.a')"
    )
    assert len(extension_names(text)) == 3


def test_an_upward_import_and_a_circle_are_seen():
    """The tests can fail: relative, absolute, inside a function; not under TYPE_CHECKING."""
    text = (
        "from typing import TYPE_CHECKING\nfrom ..system import System\nimport torchmbd.design.space\n"
        "if TYPE_CHECKING:\n    from torchmbd.viz import animate\ndef f():\n    from .. import joints\n"
    )
    result = upward(text, "torchmbd.multibody.bodies.frame")
    assert result == ["torchmbd.multibody.system.System", "torchmbd.design.space", "torchmbd.multibody.joints"]
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_the_tests_that_a_header_names_exist():
    """A header says where its claims are checked: a name that leads nowhere is a claim without a check."""
    for name, file in MODULES.items():
        for test in re.findall(r"tests/[\w/]+\.py", file.read_text()):
            assert (PACKAGE.parent / test).exists(), f"{name} names {test}"
