"""What `help` says of every public name: each argument, and of numbers their units or shapes."""

from __future__ import annotations

import ast
import inspect
import re
from operator import attrgetter
from pathlib import Path
from types import ModuleType

import pytest

import torchmbd as mbd
from torchmbd.api import all_names
from torchmbd.design import History, Measure

NAMES = [name for name in all_names() if not isinstance(attrgetter(name)(mbd), ModuleType)]


def text_of(thing: object) -> str:
    """The docstring, of a class also those that it inherits from, without examples: these use names and describe none.

    That which `dataclass` makes, the signature, is none.
    """
    family = thing.__mro__ if inspect.isclass(thing) else [thing]
    docs = [
        (own.__name__, inspect.cleandoc(own.__doc__ or "")) for own in family if own.__module__.startswith("torchmbd")
    ]
    texts = [doc for name, doc in docs if not doc.startswith(f"{name}(")]
    return re.sub(r"(?ms)^>>> .*?(?=^\s*$|\Z)", "", "\n\n".join(texts))


@pytest.mark.parametrize("name", NAMES)
def test_every_argument_is_described(name):
    thing = attrgetter(name)(mbd)
    assert text_of(thing).strip()
    if inspect.isclass(thing) and issubclass(thing, Exception):
        return
    words = set(re.findall(r"\w+", text_of(thing)))
    assert [x for x in inspect.signature(thing).parameters if x not in words] == []


@pytest.mark.parametrize("name", NAMES)
def test_methods_are_described(name):
    thing = attrgetter(name)(mbd)
    if not inspect.isclass(thing):
        return
    for key, method in vars(thing).items():
        own = inspect.isfunction(method) or isinstance(method, (property, classmethod, staticmethod))
        if own and not key.startswith("_"):
            assert inspect.getdoc(getattr(thing, key)), f"{name}.{key}"


def test_no_docstring_sends_the_reader_elsewhere():
    """A method that does what its base class says has no docstring of its own: `help` shows that of the base."""
    package = Path(mbd.__file__ or "").parent
    trees = [(file, ast.parse(file.read_text())) for file in sorted(package.rglob("*.py"))]
    kinds = (ast.FunctionDef, ast.ClassDef)
    parts = [(file, part) for file, tree in trees for part in ast.walk(tree) if isinstance(part, kinds)]
    empty = [f"{file.relative_to(package)}:{part.lineno}" for file, part in parts if is_reference(part)]
    assert len(parts) > 3000
    assert empty == []


def is_reference(part: ast.FunctionDef | ast.ClassDef) -> bool:
    return re.match(r"As (of|in|for) ", ast.get_docstring(part) or "") is not None


RESPONSES = [
    name for name in NAMES if inspect.isclass(x := attrgetter(name)(mbd)) and issubclass(x, (History, Measure))
]


@pytest.mark.parametrize("name", RESPONSES)
def test_responses_tell_their_shape_and_unit(name):
    doc = attrgetter(name)(mbd).__doc__
    assert re.search(r"\[lanes(, \w+)?\]", doc)
    assert re.search(r"\[(m|1/m|s|m/s|rad/s|1/s|m/s2|J|N|Pa|Hz|kg|rad|-)\]|\bunits?\b", doc)
