"""Errors of wrong input have the argument, its value and what is allowed as fields; the message is written from them."""

from __future__ import annotations

import ast
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import torchmbd as mbd
from torchmbd.design.response_spec import SpecError, measure_of
from torchmbd.errors import InputError, nearest, unknown
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
    assert error.value.allowed or error.value.rule


@pytest.mark.parametrize(
    ("error", "text", "reason"),
    [
        (InputError("mass", -1.0, "positive"), "mass is -1.0; allowed: positive", "= -1.0; allowed: positive"),
        (
            InputError("mass", -1.0, rule="must be positive"),
            "mass = -1.0: must be positive",
            "= -1.0: must be positive",
        ),
        (
            InputError("mass", -1.0, rule="must be positive", hint="1.0", shown="-1.0 kg"),
            "mass = -1.0 kg: must be positive. Try: 1.0",
            "= -1.0 kg: must be positive. Try: 1.0",
        ),
        (InputError(("rod", "mass"), rule="is missing"), "rod.mass is missing", "is missing"),
        (
            unknown("body", "rdo", ["rod"]),
            "body 'rdo' does not exist; allowed: rod; did you mean 'rod'?",
            ": body 'rdo' does not exist; allowed: rod; did you mean 'rod'?",
        ),
        (
            InputError(("rod", "axes"), [1.0], "a matrix", noun="axes of 'rod'", state="has shape (1,)"),
            "axes of 'rod' has shape (1,); allowed: a matrix",
            "has shape (1,); allowed: a matrix",
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
    """Every InputError and DesignFailure that is made has a value, what is allowed, or a rule, beside its argument."""
    for file in sorted(Path(mbd.__file__).parent.rglob("*.py")):
        for x in ast.walk(ast.parse(file.read_text())):
            if isinstance(x, ast.Call) and getattr(x.func, "id", "") in ("InputError", "DesignFailure"):
                fields = {k.arg for k in x.keywords} & {"value", "allowed", "rule"}
                assert len(x.args) + len(fields) >= 2, f"{file.name}:{x.lineno}"


@pytest.mark.parametrize(
    ("name", "allowed", "meant"),
    [
        ("maxiter", ["max_time", "max_lanes", "max_iterations"], "max_iterations"),  # more letters of max_time fit
        ("maxIter", ["max_time", "max_iterations"], "max_iterations"),
        ("max_tme", ["max_time", "max_iterations"], "max_time"),
        ("degrees", ["deg/s", "deg"], "deg"),
        ("STEPS", ["steps", "stop"], "steps"),
    ],
)
def test_the_nearest_name_is_one_that_begins_so(name, allowed, meant):
    assert nearest(name, allowed).endswith(f"; did you mean {meant!r}?")
