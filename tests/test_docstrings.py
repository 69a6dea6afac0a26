"""Every public name has an example in its docstring, and every example is run and gives what stands there."""

from __future__ import annotations

import contextlib
import doctest
import inspect
import io
import shutil
from collections.abc import Iterator
from operator import attrgetter
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from torchmbd import cli
from torchmbd.api import ROOMS, all_names
from torchmbd.registry import public_names

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def _members(module: ModuleType) -> list[str]:
    """What a public module offers: its list, or the classes that it defines."""
    defined = [n for n, x in vars(module).items() if getattr(x, "__module__", None) == module.__name__ and n[0] != "_"]
    place = f"{module.__name__.rpartition('.')[2]}."
    of_extensions = [name.removeprefix(place) for name in public_names() if name.startswith(place)]
    return [*getattr(module, "__all__", defined), *of_extensions]


def _objects() -> Iterator[tuple[str, Any]]:
    """Public names, and those members of public modules that are no public names of their own."""
    public = {name: attrgetter(name)(mbd) for name in all_names()}
    known = {id(result) for result in public.values()}
    for name, result in public.items():
        yield name, result
        if isinstance(result, ModuleType) and name not in ROOMS:  # names in rooms are among the public ones
            members = {member: getattr(result, member) for member in _members(result)}
            yield from ((f"{name}.{member}", x) for member, x in members.items() if id(x) not in known)


def _methods(found: Any) -> list[Any]:
    """Functions, properties and class methods that a class itself has."""
    members = (
        [getattr(x, "__func__", x) for n, x in vars(found).items() if n[0] != "_"] if inspect.isclass(found) else []
    )
    return [x for x in members if isinstance(x, property) or callable(x)]


@pytest.mark.parametrize("name", all_names())
def test_every_public_name_has_an_example(name):
    assert ">>> " in (inspect.getdoc(attrgetter(name)(mbd)) or ""), (
        f"mbd.{name}: an example is missing in its docstring"
    )


@pytest.fixture(scope="module")
def studied(tmp_path_factory, empty_store):
    """A folder in which `torchmbd new arm.yaml` and `torchmbd run arm.yaml`, a short one, were typed."""
    folder = tmp_path_factory.mktemp("studied")
    shutil.copy(empty_store, folder / "mlflow.db")
    short = ["simulate.duration=0.05", "simulate.steps=20", "starts.count=1", "optimizer.max_iterations=1"]
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()):
        patch.chdir(folder)
        assert cli.main(["new", "arm.yaml"]) == 0
        assert cli.main(["run", "arm.yaml", *short]) == 0
    return folder


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "found"), list(_objects()), ids=lambda x: x if isinstance(x, str) else "")
def test_examples(name, found, tmp_path, monkeypatch, request):
    monkeypatch.chdir(request.getfixturevalue("studied") if name in ("load", "problem_of") else tmp_path)
    for thing in (found, *_methods(found)):
        text = inspect.cleandoc(thing.__doc__ or "")
        names = {"mbd": mbd, "torch": torch, "np": np}
        test = doctest.DocTestParser().get_doctest(text, names, f"mbd.{name}", None, None)
        report: list[str] = []
        doctest.DocTestRunner(optionflags=FLAGS).run(test, out=report.append)
        assert not report, "".join(report)
