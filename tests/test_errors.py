"""Errors of wrong input have the argument, its value and what is allowed as fields; the message is written from them."""

from __future__ import annotations

import ast
import pickle
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import torchmbd as mbd
from torchmbd.design.response_spec import SpecError, measure_of
from torchmbd.errors import InputError, nearest, unknown, within
from torchmbd.study.file.faults import Fault, StudyError

any_: Any = mbd
ARM = mbd.examples.arm()
ANGLES = "arm.laminate.angles"


def space(**given: Any) -> mbd.DesignSpace:
    return mbd.DesignSpace(ARM, [ANGLES], **given)


#: A wrong call -> the path of the argument, and its value.
WRONG: dict[str, tuple[Callable[[], Any], tuple[str | int, ...], Any]] = {
    "duration": (lambda: mbd.simulate(ARM, -1.0), ("duration",), -1.0),
    "steps": (lambda: mbd.simulate(ARM, 0.1, steps=0), ("steps",), 0),
    "an option": (lambda: mbd.simulate(ARM, 0.1, steps=9, iterations=3), ("iterations",), 3),
    "an unknown option": (lambda: mbd.simulate(ARM, 0.1, steps=9, spectral=3), ("spectral",), 3),
    "start of a motion": (
        lambda: mbd.simulate(ARM, 0.1, steps=9, start={"arm.mode": 1}),
        ("start", "arm.mode"),
        "arm.mode",
    ),
    "body": (lambda: ARM.body("arn"), ("body",), "arn"),
    "lower": (lambda: space(bounds={ANGLES: (1.0, 0.5)}), ("lower", f"{ANGLES}[0]"), 1.0),
    "upper": (lambda: space(bounds={ANGLES: (0.0, "a")}), ("upper", ANGLES), "a"),
    "angle": (lambda: space(bounds={ANGLES: (-90.0, 1.0)}), ("lower", ANGLES, 0), -90.0),
    "start": (lambda: space(bounds=(-1.0, 1.0), start={ANGLES: [0.0, 1.2]}), ("start", f"{ANGLES}[1]"), 1.2),
    "links": (lambda: space(links={f"{ANGLES}[1]": {"x": 1.0}}), ("links", f"{ANGLES}[1]", "x"), 1.0),
    "axis": (lambda: mbd.Position("arm", "w").check(ARM), ("axis",), "w"),
    "window": (lambda: mbd.Max(mbd.StrainEnergy("arm"), window=(1.0, 0.0)), ("window",), (1.0, 0.0)),
}


@pytest.mark.parametrize("name", WRONG)
def test_an_error_has_its_argument_and_value(name):
    call, path, value = WRONG[name]
    with pytest.raises(InputError) as error:
        call()
    assert error.value.path == path
    assert error.value.argument == ".".join(map(str, path))
    assert error.value.value == value
    assert error.value.allowed or error.value.hint


@pytest.mark.parametrize(
    ("error", "text", "reason"),
    [
        (InputError("mass", -1.0, "positive"), "mass = -1.0: must be positive", "= -1.0: must be positive"),
        (
            InputError("nodes", [], "must have at least one row"),
            "nodes = []: must have at least one row",
            "= []: must have at least one row",
        ),
        (
            InputError("mass", -1.0, "positive", "1.0", shown="-1.0 kg"),
            "mass = -1.0 kg: must be positive. Try: 1.0",
            "= -1.0 kg: must be positive. Try: 1.0",
        ),
        (
            InputError(("rod", "mass"), hint="mass = 1.0", state="is missing"),
            "rod.mass is missing. Try: mass = 1.0",
            "is missing. Try: mass = 1.0",
        ),
        (
            unknown("body", "rdo", ["rod"]),
            "body = 'rdo': must be rod. Try: 'rod'",
            "= 'rdo': must be rod. Try: 'rod'",
        ),
        (
            unknown("body", "rdo", ["arm", "rod"], hint="bodies=[..., rdo]"),
            "body = 'rdo': must be one of arm, rod. Try: 'rod', or bodies=[..., rdo]",
            "= 'rdo': must be one of arm, rod. Try: 'rod', or bodies=[..., rdo]",
        ),
        (
            unknown("joint", "rdo", []),
            "joint = 'rdo': must be left out, because there are no names",
            "= 'rdo': must be left out, because there are no names",
        ),
        (
            InputError(("rod", "axes"), [1.0], "a matrix", noun="axes of 'rod'", state="has shape (1,)"),
            "axes of 'rod' has shape (1,): must be a matrix",
            "has shape (1,): must be a matrix",
        ),
        (
            InputError(("sweep", "rdo"), (0, 1), ["rod"], state="is not a variable"),
            "sweep.rdo is not a variable: must be rod. Try: 'rod'",
            "is not a variable: must be rod. Try: 'rod'",
        ),
        (InputError("a sentence alone"), "a sentence alone", ": a sentence alone"),
    ],
)
def test_a_message_is_written_from_the_fields(error, text, reason):
    assert str(error) == text
    assert error.reason == reason


def test_a_response_has_the_path_of_its_wrong_entry():
    with pytest.raises(SpecError) as error:
        measure_of({"max": {"strain_energy": {"body": "rod", "bdy": 1}}})
    assert error.value.argument == "max.strain_energy.bdy"


@pytest.mark.parametrize(
    "error",
    [
        InputError("mass", -1.0, "positive"),
        InputError("law", lambda t: t, "a number"),  # no other process can get this value
        InputError("angles", 2.0 * torch.ones(2, requires_grad=True), "one angle", state="have shape (2,)"),
        SpecError(("max",), "has 0 keys"),
        StudyError("study.yaml", [Fault(("model",), "is missing", 2)]),
    ],
)
def test_an_error_can_be_sent_to_another_process(error):
    received = pickle.loads(pickle.dumps(error))
    assert type(received) is type(error)
    assert (str(received), received.path, received.allowed) == (str(error), error.path, error.allowed)


@pytest.mark.thorough
def test_no_error_is_a_sentence_alone():
    """Every InputError and DesignFailure that is made says what is allowed, what is wrong, or what to try."""
    for file in sorted(Path(mbd.__file__).parent.rglob("*.py")):
        for x in ast.walk(ast.parse(file.read_text())):
            if isinstance(x, ast.Call) and getattr(x.func, "id", "") in ("InputError", "DesignFailure"):
                fields = {k.arg for k in x.keywords} & {"allowed", "hint", "state"}
                assert len(x.args) + len(fields) >= 3 or fields, f"{file.name}:{x.lineno}"


def texts(x: ast.expr | None) -> Iterator[str]:
    """The beginnings of the texts that an expression of literals may be, with {} for what it puts in."""
    match x:
        case ast.Constant(value=str(text)):
            yield text
        case ast.JoinedStr(values=parts):
            yield "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in parts)
        case ast.IfExp(body=one, orelse=other):
            yield from (*texts(one), *texts(other))
        case ast.BinOp(left=begin):
            yield from texts(begin)


def fields_of(tree: ast.AST) -> Iterator[tuple[str, ast.expr | None, int]]:
    """The fields `allowed`, `hint` and `state` that a file gives to errors, by name, with their lines."""
    names = {"InputError": 2, "DesignFailure": 2, "wrong_entry": 2, "scalar": 2, "refuse_gradients": 2}
    for x in ast.walk(tree):
        if isinstance(x, ast.Call):
            place = names.get(getattr(x.func, "id", ""))
            if place is not None and len(x.args) > place:
                yield "allowed", x.args[place], x.lineno
            yield from ((k.arg, k.value, x.lineno) for k in x.keywords if k.arg in ("allowed", "hint", "state"))
        if isinstance(x, ast.Assign):
            target, value = x.targets[0], x.value
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
            yield from (
                (name.id, y, x.lineno)
                for name, y in pairs
                if isinstance(name, ast.Name) and name.id in ("allowed", "hint")
            )


#: Beginnings of what is allowed that do not read after "must be": verbs of another kind, negations, shapes, signs.
NOT_AFTER_BE = re.compile(
    r"(not|no|none|neither|only|without|with|where|fewer|once|each|every|simulate|have|has|use|give|return|allowed|be)\b|[\[>|;:,]|<="
)
#: Words in capitals that are names: True, GRID, mbd.X; not sentences.
NAME = re.compile(r"(True|False|None)\b|[A-Z][A-Z0-9]*\b")


@pytest.mark.thorough
def test_what_is_allowed_reads_after_must_be():
    """The literal texts of all errors: `allowed` follows "must be", or has its own "must" (docstring of InputError)."""
    wrong = []
    for file in sorted(Path(mbd.__file__).parent.rglob("*.py")):
        for field, x, line in fields_of(ast.parse(file.read_text())):
            for text in texts(x):
                words = text.removeprefix("must ") if field == "allowed" else text
                bad = "allowed" in text or "Try:" in text or "; must" in text
                if field == "allowed" and words == text:
                    bad |= (
                        bool(NOT_AFTER_BE.match(text))
                        or (text[:1].isupper() and not NAME.match(text))
                        or text.startswith("must")
                    )
                elif field == "allowed":
                    bad |= words.startswith("be ")
                elif field == "hint":
                    bad |= text.endswith((".", "?"))
                wrong += [f"{file.name}:{line}: {field}: {text}"] * bad
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("name", "allowed", "meant"),
    [
        ("maxiter", ["max_time", "max_lanes", "max_iterations"], "max_iterations"),  # more letters of max_time fit
        ("maxIter", ["max_time", "max_iterations"], "max_iterations"),
        ("max_tme", ["max_time", "max_iterations"], "max_time"),
        ("degrees", ["deg/s", "deg"], "deg"),
        ("STEPS", ["steps", "stop"], "steps"),
        ("l0", ["lo", "eth0"], "lo"),
    ],
)
def test_the_nearest_name_is_one_that_begins_so(name, allowed, meant):
    assert nearest(name, allowed) == repr(meant)


def test_a_name_that_shares_letters_alone_is_not_proposed():
    assert nearest("weigh", ["model", "design", "simulate"]) == ""


def test_a_remedy_is_given_once_where_an_error_passes_through_places():
    """A name of a node within the argument of a body, with the nearest name and another remedy."""
    error = within(
        "body", within("reference", InputError("node", "left", ["left_edge", "top"], "an even number of cells"))
    )
    assert error.hint == "'left_edge', or an even number of cells"
    assert within("reference", InputError("node", "tup", ["left_edge", "top"])).hint == "'top'"
