"""Malformed files at the shell: every one ends with a message (path, value, what is allowed), no traceback, exit code 2."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchmbd import cli
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load
from torchmbd.study.file.schema import StudyFile

pytestmark = pytest.mark.thorough

TEXT = Path(__file__).parents[1].joinpath("study.yaml").read_text()

# (what is replaced, by what, path in the message, what else the message says)
CASES = [
    ("model: rod_model.py:build", "model: rod_model.py", "model", "must be package.module:function"),
    ("model: rod_model.py:build", "model: rod_model.py:bild", "model", "Try: 'build'"),
    ("model: rod_model.py:build\noptions: {layers: 2}", "model: rod_model.py:broken", "model", "ZeroDivisionError"),
    ("model: rod_model.py:build", "model: nowhere.py:build", "model", "does not exist"),
    ("model: rod_model.py:build", "model: no.where:build", "model", "cannot be imported"),
    ("model: rod_model.py:build", "model: 7", "model = 7", "string"),
    ("model: rod_model.py:build\n", "", "model", "is missing"),
    ("layers: 2", "layer: 2", "options.layer", "Try: 'layers'"),
    ("layers: 2", "layers: two", "options", "layers"),
    ("{layers: 2}", "[layers, 2]", "options", "mapping"),
    ("start: [45, -45]", "start: [45]", "start", "has 1 values: must have 2"),
    ("start: [45, -45]", "start: [45, 95]", "start", "must lie between"),
    ("start: [45, -45]", "start: [45, .inf]", "start.1", "valid number"),
    ("start: [45, -45]", "start: []", "start", "at least 1"),
    ("lower: -90", "lower: 91", "lower", "must be below upper"),
    ("lower: -90, ", "", "lower", "is missing"),
    ("lower: -90, upper: 90", "lower: -1.57, upper: 1.57", "design.rod.laminate.angles.lower", "pi / 2 in radians"),
    (
        "at_most: initial",
        "at_most: initial}\n  - {max: {angle: {body: rod, axis: z}}, at_most: 3.14, unit: deg",
        "3.14 is pi",
        "rad",
    ),
    ("unit: deg", "unit: degrees", "unit = 'degrees'", "Try: 'deg'"),
    ("unit: deg", "uint: deg", "uint", "Try: 'unit'"),
    ("rod.laminate.angles:", "rod.laminate.angle:", "design.rod.laminate.angle", "Try:"),
    ("duration: 0.01", "duration: 0", "simulate.duration = 0", "greater than 0"),
    ("duration: 0.01", "duration: 10 ms", "simulate.duration = '10 ms'", "number"),
    ("steps: 60", "steps: 6.5", "simulate.steps = 6.5", "integer"),
    ("steps: 60", "steps: 1000000000", "line 6: simulate.steps = 1000000000", "of memory"),
    ("steps: 60", "step: 60", "simulate.step", "Try: 'steps'"),
    ("steps: 60", "steps: 60, method: euler_backward", "simulate.method", "must be "),
    ("steps: 60", "steps: 60, gradients: 2", "simulate.gradients = 2", "string"),
    ("steps: 60", "steps: 60, gradients: reverse, method: rk4", "simulate.gradients", "method is 'rk4'"),
    ("{integral: {strain_energy: rod}}", "{integral: {strain_energy: rodd}}", "minimize", "Try: 'rod'"),
    ("{integral: {strain_energy: rod}}", "{integral: {energy: rod}}", "minimize.integral.energy", "strain_energy"),
    ("{integral: {strain_energy: rod}}", "{integral: rod}", "minimize.integral", "mapping"),
    ("{integral: {strain_energy: rod}}", "{}", "minimize", "exactly one"),
    ("at_most: initial", "at_most: start", "subject_to.0.at_most = 'start'", "initial"),
    ("at_most: initial", "at_more: 1", "subject_to.0", "at_most"),
    ("at_most: initial", "at_most: 1, at_least: 0", "subject_to.0", "exactly one of"),
    ("at_most: initial", "at_most: initial, window: [0, 1]", "subject_to.0", "must look at most at"),
    ("name: mmfd", "name: mmdf", "optimizer.name = 'mmdf'", "Try: 'mmfd'"),
    ("max_iterations: 2", "max_iterations: -2", "optimizer.max_iterations = -2", "greater than 0"),
    ("max_iterations: 2", "max_iteration: 2", "optimizer.max_iteration", "Try: 'max_iterations'"),
    ("sampler: sobol", "sampler: sobel", "starts.sampler = 'sobel'", "Try: 'sobol'"),
    ("count: 2, ", "", "starts", "needs 'count'"),
    ("count: 2, ", "count: 2000000, ", "starts.count = 2000000", "less than or equal to 1048576"),
    ("seed: 7", "seed: seven", "starts.seed = 'seven'", "integer"),
    ("tracking: {experiment: test}", "tracking: {uri: mlflow.db}", "tracking.uri = 'mlflow.db'", "sqlite:"),
    ("tracking: {experiment: test}", "tracking: {experiment: test}\ntracking: {}", "tracking", "is given twice"),
    ("tracking: {experiment: test}", "trakcing: {experiment: test}", "trakcing", "Try: 'tracking'"),
    ("model:", "\tmodel:", "", "is not YAML"),
    ("options: {layers: 2}", "options: {layers: 2", "", "is not YAML"),
    ("options: {layers: 2}", "options: &a {layers: 2}", "options", "anchors"),
    (TEXT, "", "", "must have sections such as model:"),
    ("max_iterations: 2", "max_iterations: 2, kkt: [1]", "optimizer.kkt = [1]", "must be a number"),
    ("max_iterations: 2", "max_iterations: 2, metric: 3", "optimizer.metric", "max_analyses"),
    ("max_iterations: 2", "max_iterations: 2, max_lanes: many", "optimizer.max_lanes = 'many'", "an integer"),
    ("steps: 60", "steps: 60, method: hht_alpha, alfa: -0.1", "simulate.alfa", "Try: 'alpha'"),
    ("steps: 60", "steps: 60, method: hht_alpha, alpha: strong", "simulate.alpha = 'strong'", "must be -1/3"),
    ("steps: 60", "steps: 60, method: hht_alpha, spectral_radius: 0.8", "simulate.spectral_radius", "must be "),
    ("steps: 60", "steps: 60, iterations: 3", "simulate.iterations = 3", "must be two positive integers"),
    ("steps: 60", "steps: 60, iterations: [3, x]", "simulate.iterations = [3, 'x']", "must be two positive integers"),
]


def refused(capsys, *arguments: str) -> str:
    """Run the command line; the file must be refused, and in no other way than by its message."""
    code = cli.main([*arguments])
    output = capsys.readouterr()
    assert code == 2, output.err
    assert "Traceback" not in output.out + output.err
    return output.err


@pytest.mark.parametrize(("old", "new", "path", "message"), CASES, ids=[str(k) for k in range(len(CASES))])
def test_every_fault_is_named_with_path_and_what_is_allowed(folder, capsys, old, new, path, message):
    assert old in TEXT
    file = folder / "study.yaml"
    file.write_text(TEXT.replace(old, new))
    error = refused(capsys, "check", str(file))
    assert path in error
    assert message in error
    assert re.match(r".*study\.yaml: \d+ errors?\n", error)
    room = r"[0-9.]+ [MGT]B are available|at most \d+"  # changes from one moment to the next
    assert re.sub(room, "", refused(capsys, "run", str(file))) == re.sub(room, "", error)


@pytest.mark.parametrize(
    "where", ["{keys}", "simulate: {{duration: 0.01, {keys}}}", "design: {{{keys}}}", "tracking: {{{keys}}}"]
)
def test_a_flood_of_faults_is_cut(folder, capsys, where):
    keys = (", " if "{{" in where else "\n").join(f"k{i}: 1" for i in range(2_000))
    file = folder / "study.yaml"
    file.write_text(where.format(keys=keys))
    error = refused(capsys, "check", str(file))
    assert re.search(r"\n  \.\.\. and \d+ more\n$", error)
    assert error.count("\n") == 22
    assert len(error) < 10_000


def test_a_long_fault_is_cut(folder, capsys):
    file = folder / "study.yaml"
    file.write_text(
        TEXT.replace("{integral: {strain_energy: rod}}", "{integral: {strain_energy: " + "r" * 500_000 + "}}")
    )
    error = refused(capsys, "check", str(file))
    assert len(error) < 5_000
    assert "must be one of crank, rod, slider" in error


scraps = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats(-1, 1) | st.sampled_from(["rod", "deg", "x", "", "7"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*StudyFile.model_fields, "x"]), inner),
    max_leaves=5,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from([*StudyFile.model_fields, "modl"]), scraps, max_size=6))
def test_scraps_of_files_are_refused(folder, capsys, data):
    file = folder / "study.yaml"
    file.write_text(yaml.safe_dump(data))
    assert refused(capsys, "check", str(file)).count("\n") >= 2


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, len(TEXT) - 1), st.sampled_from(["", ":", "{", "]", "\n", "\x00", "é", "- ", "!", "*"]))
def test_a_slip_of_the_keyboard_is_refused_or_harmless(folder, place, slip):
    """One character replaced anywhere: a plan, or the error that names faults; no other exception."""
    file = folder / "study.yaml"
    file.write_text(TEXT[:place] + slip + TEXT[place + 1 :])
    with contextlib.suppress(StudyError):
        load(file)


def test_all_that_a_key_may_be_is_said(write):
    """Of a key that takes a word or a mapping: the words, the other kind, and what is meant."""
    with pytest.raises(StudyError) as error:
        load(write(simulate={"duration": 0.01, "steps": 4, "start": "equilibrum"}))
    said = "must be one of assembled, equilibrium; or a mapping (key: value). Try: 'equilibrium'"
    assert str(error.value).endswith(f"simulate.start = 'equilibrum': {said}")


@pytest.mark.parametrize(
    "key", ["simulate.steps", "simulate.start", "optimizer.max_iterations", "starts.count", "starts", "tracking.uri"]
)
def test_a_key_without_a_value_is_named(write, key):
    with pytest.raises(StudyError, match=f"{key} = null: must have a value, or be left out"):
        load(write(), [f"{key}=null"])
