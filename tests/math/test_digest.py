"""Digests: what changes a number changes the digest; names of variables' places, comments and the process do not."""

from __future__ import annotations

import functools
import importlib.util
import math
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import scipy.sparse
import torch

import torchmbd as mbd
from tests.refused import warned
from torchmbd.math.digest import digest, source_digest

PACKAGE = Path(mbd.__file__).parent


@dataclass
class Law:
    k: float
    table: torch.Tensor

    def __call__(self, t):
        return self.k * t


def module(folder: Path, text: str, name: str = "law"):
    """A user's module of that text."""
    file = folder / f"{name}.py"
    file.write_text(text)
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    result = importlib.util.module_from_spec(spec)
    sys.modules[name] = result
    exec(compile(text, str(file), "exec"), vars(result))  # no bytecode of an earlier text
    return result


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1.0, 1),
        (0.1, np.nextafter(0.1, 1.0)),
        (torch.tensor([0.1]), torch.tensor([0.1 + 1e-8])),
        (torch.zeros(2, dtype=torch.float64), torch.zeros(2)),
        (torch.zeros(2, 3), torch.zeros(3, 2)),
        (np.arange(3), np.arange(3.0)),
        (torch.eye(2).to_sparse(), (2 * torch.eye(2)).to_sparse()),
        (scipy.sparse.eye_array(2).tocsc(), 2 * scipy.sparse.eye_array(2).tocsc()),
        ([1, [2]], [[1], 2]),
        ({"a": 1}, {"a": 2}),
        ({1, 2}, {1, 3}),
        (Law(1.0, torch.zeros(2)), Law(2.0, torch.zeros(2))),
        (Law(1.0, torch.zeros(2)), Law(1.0, torch.ones(2))),
        (functools.partial(max, 1), functools.partial(max, 2)),
        (math.sin, math.cos),
        (np.sin, np.cos),
        (torch.sin, torch.cos),
        ([1.0].count, [2.0].count),
        (b"a", "a"),
    ],
)
def test_other_contents_have_another_digest(one, other):
    assert digest(one) == digest(one)
    assert digest(one) != digest(other)


def test_a_part_that_two_share_is_not_two_equal_parts():
    a, b = torch.ones(2), torch.ones(2)
    assert digest([a, a]) != digest([a, b])


def test_numbers_that_are_set_aside_do_not_count_but_their_shape_does():
    a, b, c = torch.ones(2), torch.zeros(2), torch.zeros(3)
    assert digest([a], ignored=[a]) == digest([b], ignored=[b])
    assert digest([b], ignored=[b]) != digest([c], ignored=[c])


def test_what_was_worked_out_and_kept_does_not_count():
    class Beam:
        def __init__(self):
            self.length = 2.0

        @functools.cached_property
        def mass(self):
            return self.length * 3

    fresh, used = Beam(), Beam()
    assert used.mass == 6.0
    assert digest(fresh) == digest(used)


LAW = """
import math
import helper
RATE = 2.0
def inner(t):
    return helper.gain(t)
class Spring:
    stiffness = 3.0
    def force(self, t):
        return self.stiffness * t
def make(offset):
    def law(t, scale=1.5):
        return RATE * inner(t) + Spring().force(t) + offset * scale + math.sin(t)
    return law
"""
HELPER = "FACTOR = 4.0\ndef gain(t):\n    return FACTOR * t\n"


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("RATE = 2.0", "RATE = 2.5", False),
        ("stiffness = 3.0", "stiffness = 3.5", False),
        ("self.stiffness * t", "self.stiffness + t", False),
        ("scale=1.5", "scale=1.6", False),
        ("math.sin(t)", "math.cos(t)", False),
        ("return helper.gain(t)", "return -helper.gain(t)", False),
        ("FACTOR = 4.0", "FACTOR = 5.0", False),
        ("FACTOR * t", "FACTOR + t", False),
        ("RATE = 2.0", "# the rate\n\nRATE  =  2.0  # [1/s]", True),
        ("    def law", "    # a law\n    def law", True),
        ("FACTOR = 4.0", "# in between\nFACTOR = 4.0", True),
    ],
)
def test_the_code_of_a_law_and_what_it_names_count(tmp_path, old, new, same):
    def made(text, helper, offset=1.0):
        module(tmp_path, helper, "helper")
        return digest(module(tmp_path, text).make(offset))

    before = made(LAW, HELPER)
    assert made(LAW, HELPER) == before
    assert made(LAW, HELPER, 2.0) != before
    assert (LAW + HELPER).count(old) == 1
    assert (made(LAW.replace(old, new), HELPER.replace(old, new)) == before) is same


def test_what_cannot_be_compared_is_said():
    with warned("_thread.lock", "compared"):
        digest(__import__("threading").Lock())
    names: dict = {"__name__": "typed"}
    exec("def law(t):\n    return t", names)
    with warned("the function law", "compared"):
        digest(names["law"])


def test_lambdas_in_one_line_differ():
    # fmt: off
    laws = [lambda p, q: p + q, lambda p, q: p - q, lambda p, q: p if q else -p, lambda p, q: (lambda: p + q), lambda p, q: (lambda: p - q)]  # noqa: E501
    # fmt: on
    laws += [laws[3](1.0, 2.0), laws[4](1.0, 2.0)]
    assert len({digest(law) for law in laws}) == len(laws)
    assert digest(laws[0]) == digest(laws[0])


class Pair(NamedTuple):
    k: float


def test_methods_that_python_writes_do_not_need_a_text():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert digest(Law, Pair) == digest(Law, Pair)


@pytest.mark.parametrize("file", ["a.py", "sub/a.cpp", "sub/notes.txt"])
def test_sources_count(tmp_path, file):
    (tmp_path / "sub").mkdir()
    for name in ("a.py", "sub/a.cpp", "sub/notes.txt"):
        (tmp_path / name).write_text("x = 1;\n")
    before, without = source_digest(tmp_path), source_digest(tmp_path, ["sub"])
    (tmp_path / file).write_text("x = 2;\n")
    assert (source_digest(tmp_path) == before) is file.endswith(".txt")
    assert (source_digest(tmp_path, ["sub"]) == without) is file.startswith("sub")


@pytest.mark.thorough
def test_two_processes_have_one_digest(tmp_path):
    """Sets and dictionaries of words come in another order with every seed of Python's hashes."""
    script = tmp_path / "script.py"
    script.write_text(
        "from torchmbd.math.digest import digest\n"
        "words = {'a', 'b', 'c', 'd', 'e'}\n"
        "def law(x):\n    return x in {'a', 'b', 'c', 'd'}\n"
        "print(digest(words, dict.fromkeys(words), law))"
    )
    result = {
        subprocess.run(
            [sys.executable, script], env={"PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(result) == 1


def test_the_digest_of_all_sources_is_cheap():
    began = time.process_time()
    source_digest(PACKAGE)
    assert time.process_time() - began < 0.2


def test_a_copy_of_the_package_has_its_digest(tmp_path):
    shutil.copytree(PACKAGE / "design", tmp_path / "design")
    assert source_digest(tmp_path / "design") == source_digest(PACKAGE / "design")


class Turned:
    """A thing that works its sine out when it is first asked, and keeps it."""

    derived_state = ("sine",)

    def __init__(self, angle: float) -> None:
        self.angle, self.sine = angle, None


def test_derived_state_has_no_influence():
    x = Turned(0.3)
    before = digest(x)
    x.sine = 0.2955
    assert digest(x) == before
    x.angle = 0.4
    assert digest(x) != before


def test_a_switch_that_no_module_of_torchmbd_reads_has_no_influence():
    """It has one in a module of a user, whose law may read it."""
    for module, same in ((mbd.examples.pendulum(), True), (torch.nn.Dropout(), False)):
        before = digest(module)
        module.eval()
        assert (digest(module) == before) is same


Law = Callable[[float], complex]
LAWS: list[Law] = []


def annotated(law: Law, x: list[Law | None]) -> Law | None:
    kinds = (list[int], int | float, Law)
    return law if kinds and x is LAWS else None


def test_types_with_arguments_have_digests():
    """In annotations, where they compute nothing, and as values."""
    assert digest(annotated) == digest(annotated)
    assert digest(Law) != digest(Callable[[float], float])
    assert digest(list[int]) != digest(list[float])
    assert digest(int | float) == digest(int | float)
