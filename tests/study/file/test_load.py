"""Experiment files: what is right becomes a plan, what is wrong is named, all of it at once."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import torchmbd as mbd
from tests.refused import warned
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load_study as load
from torchmbd.study.file.model import find_function
from torchmbd.study.file.schema import StudyFile
from torchmbd.study.file.yaml_file import parse_yaml


def faults(file, *overrides):
    with pytest.raises(StudyError) as caught:
        load(file, overrides)
    return caught.value.faults


def test_a_valid_file_becomes_a_plan(write):
    plan = load(write())
    assert plan.name == "study"
    assert plan.columns.labels == ("rod.laminate.angles[0]", "rod.laminate.angles[1]")
    assert plan.columns.names == ("angle_1_deg", "angle_2_deg")
    assert plan.columns.heading(1) == "angle 2 [deg]"
    x = plan.columns.si(np.array([180.0, -45.0]))
    np.testing.assert_allclose(x, [math.pi, -math.pi / 4])
    assert plan.columns.by_name(x) == pytest.approx({"angle_1_deg": 180.0, "angle_2_deg": -45.0})


def test_the_resolved_file_is_a_file_again(write):
    """Defaults filled in, in the form of the file: what MLflow keeps can be run."""
    plan = load(write(optimizer=None, tracking=None))
    resolved = plan.resolved()
    assert resolved["optimizer"] == {"name": "auto", "max_iterations": 60}
    assert resolved["simulate"]["method"] == "generalized_alpha"
    assert resolved["subject_to"] == [{"max": {"strain_energy": "rod"}, "at_most": "initial"}]
    again = StudyFile.model_validate(resolved)
    assert again.resolved() == resolved


@pytest.mark.thorough
@pytest.mark.parametrize("way", ["forward", "reverse"])
def test_which_way_gradients_come_can_be_chosen(write, way):
    simulate = {"duration": 0.002, "steps": 20}
    result = load(write(simulate=simulate | {"gradients": way})).simulated
    assert result.simulate(result.start[None], gradients=True).stats["gradients"] == way
    assert load(write(simulate=simulate)).resolved()["simulate"]["gradients"] == "auto"


@pytest.mark.thorough
def test_steps_that_are_left_out_have_a_tolerance(write):
    plain = load(write(simulate={"duration": 0.002})).simulated
    assert plain.chooses_steps
    assert plain.tolerance == 0.01
    finer = load(write(simulate={"duration": 0.002, "tolerance": 1e-3})).simulated
    assert finer.tolerance == 1e-3
    assert finer.settings() != plain.settings()
    for wrong in (0, 1.0, "small"):
        [fault] = faults(write(simulate={"duration": 0.002, "tolerance": wrong}))
        assert fault.path == ("simulate", "tolerance")


@pytest.mark.thorough
def test_motions_start_where_the_file_says(write):
    simulate = {"duration": 0.002, "steps": 20}
    start = {"rod.modal": [1e-4] * load(write()).system.body("rod").modes}
    result = load(write(simulate=simulate | {"start": start})).simulated
    assert result.motion(result.start).body("rod").w[0, 0].tolist() == pytest.approx(start["rod.modal"])
    assert load(write(simulate=simulate | {"start": "equilibrium"})).simulated.simulation.start == "equilibrium"
    assert load(write(simulate=simulate)).resolved()["simulate"]["start"] == "assembled"
    for wrong, words in (("equilibriun", "equilibrium"), ({"rod.mode": [0.0]}, "rod.modal")):
        [fault] = faults(write(simulate=simulate | {"start": wrong}))
        assert fault.path[:2] == ("simulate", "start")
        assert words in fault.text


@pytest.mark.thorough
def test_scenarios_of_a_file_are_those_of_python(write):
    simulate = {"duration": 0.002, "steps": 8}
    cases = [
        {"name": "thin", "set": {"rod.laminate.thickness": 1e-3}},
        {"set": {"rod.laminate.thickness": {"value": 2, "unit": "mm"}}, "weight": 3},
    ]
    loaded = load(write(simulate=simulate, scenarios=cases, combine={"objective": "mean"})).simulated
    assert isinstance(loaded, mbd.Scenarios)
    assert list(loaded.scenarios) == ["thin", "scenario 2"]
    assert loaded.weights.tolist() == [0.25, 0.75]
    assert loaded.scenarios["scenario 2"]["rod.laminate.thickness"].tolist() == [2e-3, 2e-3]
    assert loaded.evaluate(loaded.start[None], False)[0].status == "ok"
    for wrong, words in (
        ({"combine": {"objective": "mean"}}, "without scenarios"),
        ({"scenarios": [{"set": {"rod.laminate.thickness": -1e-3}}]}, "= -0.001: must be positive numbers"),
        ({"scenarios": [{"set": {"rod.laminate.thicknes": 1.0}}]}, "rod.laminate.thickness"),
        ({"scenarios": cases, "combine": {"objective": "all"}}, "worst, mean"),
        ({"scenarios": [copy.deepcopy(cases[0]), cases[0]]}, "each name once"),
    ):
        result = [fault.text for fault in faults(write(simulate=simulate, **wrong))]
        assert any(words in text for text in result), result


@pytest.mark.thorough
def test_phases_come_from_a_function(write):
    """A motion in two phases of one mechanism is that of one."""
    simulate = {"duration": 0.01, "steps": 60}
    plans = [load(write(simulate=simulate | more)) for more in ({}, {"phases": "rod_model.py:in_two"})]
    whole, halved = (plan.simulated for plan in plans)
    assert [phase.until for phase in halved.simulation.phases] == [0.004, None]
    values = [p.evaluate(p.start[None], gradients=False)[0].objective for p in (whole, halved)]
    assert values[0] == pytest.approx(values[1], rel=1e-4)
    assert "phases" in load(write(simulate=simulate | {"phases": "rod_model.py:in_two"})).resolved()["simulate"]
    for name, said in (
        ("too_long", "must be increasing times before duration"),
        ("no_phases", "must return a list of mbd.Phase"),
        ("broken_phases", "ZeroDivisionError in"),
        ("build", "annotated with -> list"),
        ("in_too", "Try: 'in_two'"),
    ):
        [fault] = faults(write(simulate=simulate | {"phases": f"rod_model.py:{name}"}))
        assert fault.path == ("simulate", "phases")
        assert said in fault.text


def test_an_override_changes_the_plan(write):
    plan = load(write(), ["optimizer.max_iterations=5", "options.cells=3"])
    assert plan.max_iterations == 5
    assert len(plan.system.body("rod").mesh.nodes) == (3 + 1) * (2 + 1)


WRONG = """
modl: rod_model.py:build
options: [3]
design:
  rod.laminate.angles: {start: [45, x], lower: -90, uper: 90, unit: degree}
  other: 3
simulate: {duration: -1, method: generalised_alpha, steps: 1.5}
minimize: {integrl: {strain_energy: rod}}
subject_to:
  - {max: {strain_energi: rod}, at_most: first}
  - {max: {strain_energy: rod}}
optimizer: {name: mmdf, max_iterations: true}
starts: {sampler: sobol, seed: -1}
tracking: {experiment: "", uri: foo}
"""


def test_everything_that_is_wrong_is_named_at_once(write):
    texts = [str(fault) for fault in faults(write(WRONG))]
    expected = [
        "line 2: modl = 'rod_model.py:build' is an unknown key: must be one of model, options, design",
        "line 3: options = [3]: must be a mapping",
        "line 5: design.rod.laminate.angles.start.1 = 'x': must be a valid number",
        "line 5: design.rod.laminate.angles.uper = 90 is an unknown key: must be one of start, lower, upper, "
        "unit, tolerance, step. Try: 'upper'",
        "line 5: design.rod.laminate.angles.unit = 'degree': must be one of deg, rad, m, cm, mm",
        "line 6: design.other = 3: must be a mapping",
        "line 7: simulate.duration = -1: must be greater than 0",
        "Try: 'generalized_alpha'",
        "line 7: simulate.steps = 1.5: must be a valid integer",
        "line 8: minimize.integrl is an unknown name: must be one of ",
        "Try: 'integral'",
        "line 10: subject_to.0.max.strain_energi is an unknown name: must be one of ",
        "line 10: subject_to.0.at_most = 'first': must be 'initial'; or a valid number",
        "line 11: subject_to.1: has no limit: must have exactly one of at_most, at_least, equal",
        "line 12: optimizer.name = 'mmdf': must be one of ",
        "Try: 'mmfd'",
        "line 12: optimizer.max_iterations = true: must be a valid integer",
        "line 13: starts.seed = -1: must be greater than or equal to 0",
        "line 14: tracking.experiment = ''",
        "line 14: tracking.uri = 'foo': must be a store of sqlite:",
        "model is missing",
    ]
    for text in expected:
        assert any(text in result for result in texts), text


@pytest.mark.parametrize(
    ("sections", "path", "message"),
    [
        (
            {"options": {"layrs": 2}},
            "options.layrs",
            "is not an option: must be one of layers, cells, payload. Try: 'layers'",
        ),
        ({"options": {"cells": 0}}, "options", "cells"),
        ({"model": "rod_model.py:buld"}, "model", "names no function of rod_model.py: must be "),
        ({"model": "../rod_model.py:build"}, "model", "lies outside the folder of the experiment file"),
        ({"model": "os:system", "options": {"command": "true"}}, "model", "names no function of os: must be "),
        ({"model": "json:dumps", "options": {}}, "model", "says nothing about what it returns"),
        ({"model": "missing.py:build"}, "model", "missing.py' does not exist: must be a Python file"),
        ({"model": "no.such.module:build"}, "model", "= 'no.such.module' cannot be imported"),
        ({"model": "build"}, "model", "= 'build': must be package.module:function"),
        (
            {"model": "rod_model.py:no_system", "options": {}},
            "model",
            "says -> int about what it returns: must be annotated with",
        ),
        ({"model": "rod_model.py:broken", "options": {}}, "model", "ZeroDivisionError in"),
        ({"simulate": {"duration": "5 ms"}}, "simulate.duration", "Try: 0.005 (s)"),
        (
            {"subject_to": [{"mass": "rod", "at_most": "90 g"}]},
            "subject_to.0.at_most",
            "Try: 0.09 (kg), or 90 and unit: g",
        ),
        ({"simulate": {"duration": 0.1, "rtoll": 1}}, "simulate.rtoll", "is not an option"),
        ({"simulate": {"duration": 0.1, "method": "dopri5", "refresh": 1}}, "simulate.refresh", "of method 'dopri5'"),
        ({"optimizer": {"name": "mmfd", "ctt": 1}}, "optimizer.ctt", "is not an option"),
        ({"minimize": {"integral": {"strain_energy": "crank"}}}, "minimize.integral.strain_energy", "must be rod"),
        ({"minimize": {}}, "minimize", "has 0 keys: must have exactly one"),
        ({"minimize": {"max": {"strain_energy": "rod"}, "windw": [0, 1]}}, "minimize.windw", "Try: 'window'"),
        ({"minimize": {"max": {"position": {"body": "rod"}}}}, "minimize.max.position", "lacks 'axis'"),
        (
            {"minimize": {"weighted_sum": [{"weight": 1, "mass": "rod"}, {"weight": 2, "mass": "rodd"}]}},
            "minimize.weighted_sum.1.mass",
            "Try: 'rod'",
        ),
        (
            {"minimize": {"max": {"strain_energy": "rod"}, "window": [0.1, 9]}},
            "minimize.window",
            "looks at t = 9 s: must look at most at duration=0.01 s",
        ),
        ({"starts": {"sampler": "sobol"}}, "starts", "sampler 'sobol' needs 'count'"),
        ({"starts": {"sampler": "none", "count": 3}}, "starts", "sampler 'none' takes no 'count'"),
        ({"starts": {"sampler": "none", "include_initial": False}}, "starts", "leaves no start"),
        ({"starts": {"sampler": "given", "points": [[1]]}}, "starts.points.0", "has 1 values: must have 2"),
        ({"starts": {"sampler": "given", "points": [[1, 91]]}}, "starts.points.0", "must lie between"),
        ({"sweep": {"rod.laminate.angles[0]": {"from": 0, "to": 1, "count": 2}}}, "sweep", "and optimizer and starts"),
        ({"design": {}}, "design", "is empty: must have at least one"),
    ],
)
def test_each_fault_has_its_path_and_what_is_allowed(write, sections, path, message):
    (fault,) = faults(write(**sections))
    assert ".".join(map(str, fault.path)) == path
    assert message in fault.text


@pytest.mark.parametrize(
    ("variable", "path", "message"),
    [
        ({"start": [1, 2, 3]}, "start", "has 3 values: must have 2, or one number for all"),
        ({"start": [1, 95]}, "start", "must lie between"),
        ({"lower": 91}, "lower", "must be below upper"),
        ({"upper": [90, float("nan")]}, "upper.1", "= '.nan': must be a valid number"),
    ],
)
def test_sizes_and_ranges_of_the_design(write, variable, path, message):
    design = {"rod.laminate.angles": {"start": [45, -45], "lower": -90, "upper": 90, "unit": "deg"} | variable}
    (fault,) = faults(write(design=design))
    assert fault.path == ("design", "rod.laminate.angles", *[int(p) if p.isdigit() else p for p in path.split(".")])
    assert message in fault.text


@pytest.mark.parametrize("unit", ["rad", "none"])
def test_degrees_that_are_said_to_be_radians_are_named(write, unit):
    result = faults(write(design={"rod.laminate.angles": {"start": [45, 1], "lower": -90, "upper": 90, "unit": unit}}))
    assert {fault.path[-1] for fault in result} == {"start", "lower", "upper"}
    for fault in result:
        assert f"with unit: {unit}" in fault.text
        assert "must lie in the range -2 pi to 2 pi. Try: unit: deg" in fault.text


def test_millimeters_that_are_said_to_be_meters_are_doubted(write):
    with warned("rod.laminate.thickness", "3 m"):
        load(write(design={"rod.laminate.thickness": {"lower": 1e-3, "upper": 3, "unit": "m"}}))


def test_a_parameter_that_does_not_exist_has_a_nearest(write):
    design = {"rod.laminate.angle": {"lower": -90, "upper": 90, "unit": "deg"}}
    (fault,) = faults(write(design=design))
    assert "Try: 'rod.laminate.angles'" in fault.text


def test_names_of_the_model_are_checked_beside_faults_of_the_schema(write):
    """A negative duration must not hide a misspelt body."""
    result = faults(write(simulate={"duration": -1}, minimize={"integral": {"strain_energy": "rood"}}))
    assert sorted(fault.path[0] for fault in result) == ["minimize", "simulate"]


PLIES = {"lower": -90, "upper": 90, "unit": "deg"}
THICKNESS = {"lower": 1, "upper": 5, "unit": "mm"}
PAIR = {"rod.laminate.angles[1]": {"rod.laminate.angles[0]": -1}}
ENERGY = {"max": {"strain_energy": "rod"}}


@pytest.mark.parametrize(
    ("sections", "expected"),
    [
        (
            {"design": {"rod.laminate.foo": THICKNESS, "rod.laminate.angles": {"start": [95, -45]} | PLIES}},
            {"design.rod.laminate.foo": "must be one of", "design.rod.laminate.angles.start": "must lie between"},
        ),
        (
            {"design": {"rod.laminate.thickness": 3, "rod.laminate.angles": {"start": [95, -45]} | PLIES}},
            {"design.rod.laminate.thickness": "mapping", "design.rod.laminate.angles.start": "must lie between"},
        ),
        (
            {"design": {"rod.laminate.angles": {"start": [1, 2, 3], "lower": -90, "unit": "deg"}}},
            {"design.rod.laminate.angles.upper": "is missing", "design.rod.laminate.angles.start": "has 3 values"},
        ),
        (
            {
                "design": {"rod.laminate.angles": {"start": [45, -45]} | PLIES},
                "links": {"rod.laminate.angles[1]": {"rod.laminate.angles[5]": -1}},
            },
            {
                "design.rod.laminate.angles.start": "has 2 values: must have 1",
                "links.rod.laminate.angles[1].rod.laminate.angles[5]": "is not an entry, or follows others",
            },
        ),
        (
            {"links": {"rod.laminate.angles[7]": {"constant": 1}, "rod.laminate.angles[1]": {"x": 1, "y": 1}}}
            | {"design": {"rod.laminate.angles": PLIES}},
            {
                "links.rod.laminate.angles[7]": "is not an entry of a design variable",
                "links.rod.laminate.angles[1].x": "is not an entry, or follows others",
                "links.rod.laminate.angles[1].y": "is not an entry, or follows others",
            },
        ),
        (
            {"design": {"rod.laminate.angles": {"start": [45, -45], "unit": "deg"}}, "links": PAIR},
            {
                "design.rod.laminate.angles.start": "has 2 values: must have 1",
                "design.rod.laminate.angles.lower": "is missing: must be a number",
                "design.rod.laminate.angles.upper": "is missing: must be a number",
            },
        ),
        (
            {
                "scenarios": [
                    {"set": {"crank.mas": 1.0}},
                    {"options": {"cells": 0}},
                    {"options": {"cels": 1}},
                    {"set": {"rod.laminate.angles": [1, 2]}},
                    {"weight": -1, "options": {"payload": 1.0}},
                ]
            },
            {
                "scenarios.0.set.crank.mas": "does not exist",
                "scenarios.1.options": "cells",
                "scenarios.2.options.cels": "is not an option",
                "scenarios.3.set.rod.laminate.angles": "because it is an angle",
                "scenarios.4.weight": "must be greater than or equal to 0",
            },
        ),
        (
            {"design": {"rod.laminate.thickness": PLIES, "rod.laminate.angles": THICKNESS}},
            {"design.rod.laminate.thickness.unit": "= 'deg'", "design.rod.laminate.angles.unit": "= 'mm'"},
        ),
        (
            {"subject_to": [ENERGY, {"max": {"strain_energy": "rood"}, "at_most": 1.0}]},
            {"subject_to.0": "has no limit", "subject_to.1.max.strain_energy": "body = 'rood'"},
        ),
        (
            {"minimize": None, "tradeoff": {"a": {"mas": "rod"}, "b": {"mass": "rood"}}},
            {"tradeoff.a.mas": "Try: 'mass'", "tradeoff.b.mass": "body = 'rood'"},
        ),
        (
            {
                "design": {"rod.laminate.angles": {"start": [95, 1]} | PLIES},
                "starts": {"sampler": "given", "points": [[1], [1, 2]]},
            },
            {"design.rod.laminate.angles.start": "must lie between", "starts.points.0": "has 1 values"},
        ),
    ],
)
def test_a_fault_hides_no_other(write, sections, expected):
    """Of variables, links, scenarios and constraints, each is checked whatever is wrong with the others."""
    result = {".".join(map(str, fault.path)): fault.text for fault in faults(write(**sections))}
    assert result.keys() == expected.keys()
    for path, words in expected.items():
        assert words in result[path]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "rod.laminate.angles",
            "is not a single design variable: must be one of rod.laminate.angles[0], rod.laminate.angles[1]",
        ),
        ("rod.laminate.angle[0]", "Try: 'rod.laminate.angles[0]'"),
        ("rod.laminate.angles[1]", "(95 deg): must lie between"),
    ],
)
def test_a_fault_of_a_sweep_stands_at_the_sweep(write, name, words):
    """Also beside a fault of another section."""
    sweep = {"optimizer": None, "starts": None, "sweep": {name: {"from": -10, "to": 95, "count": 3}}}
    [fault] = faults(write(**sweep))
    assert fault.path == ("sweep", name)
    assert words in fault.text
    both = faults(write(**sweep, minimize={"max": {"strain_energy": "rood"}}))
    assert [other.path[0] for other in both] == ["minimize", "sweep"]


def test_a_fault_of_an_override_names_the_override(write):
    (fault,) = faults(write(), "optimizer.max_iterations=many")
    assert str(fault).startswith("in override 'optimizer.max_iterations=many': optimizer.max_iterations = 'many'")


@pytest.mark.parametrize("text", ["", "[]", "3", "text", "- a", "null"])
def test_what_is_no_file_of_sections(write, text):
    (fault,) = faults(write(text))
    assert "must have sections such as model:" in fault.text


keys = st.sampled_from(list(StudyFile.model_fields))
words = st.sampled_from(["rod", "deg", "initial", "mmfd", "sobol", "max", "integral", "strain_energy", "x", ""])
scraps = st.recursive(
    st.none() | st.booleans() | st.integers(-100, 100) | st.floats(allow_nan=False, allow_infinity=False) | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words | keys, inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.thorough
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([name for name in StudyFile.model_fields if name != "model"]), scraps)
def test_any_section_is_accepted_or_refused_with_its_path(write, section, scrap):
    """No scrap of data in any section ends in another exception than StudyError."""
    try:
        plan = load(write(**{section: scrap}))
    except StudyError as error:
        assert any(fault.path[:1] in ((section,), ()) for fault in error.faults)  # noqa: PT017
    else:
        assert parse_yaml(plan.origin.file.read_text()).data.get(section) == scrap


SHARED = """
import torchmbd as mbd
TIP = "left"
def build(tip: str = "left") -> mbd.System:
    global TIP
    TIP = tip
    return mbd.examples.arm()
def height() -> mbd.Measure:
    return mbd.Max(mbd.Displacement("arm", "z", node=TIP))
"""
QUESTION = {
    "model": "arm.py:build",
    "options": {"tip": "right"},
    "design": {"arm.laminate.angles": {"start": [30.0, -30.0], "lower": -90, "upper": 90, "unit": "deg"}},
    "simulate": {"duration": 0.05, "steps": 30},
    "minimize": {"function": "arm.py:height"},
    "subject_to": None,
    "starts": None,
}


@pytest.mark.parametrize("place", ["arm.py", "heights.py", "beside"])
def test_functions_of_a_file_share_its_globals(write, folder, place):
    """They are those of one execution, also where another file imports this one."""
    (folder / "arm.py").write_text(SHARED)
    (folder / "heights.py").write_text(
        "import arm\nimport torchmbd as mbd\ndef height() -> mbd.Measure:\n    return arm.height()\n"
    )
    (folder / "beside").mkdir()
    (folder / "beside" / "arm.py").write_text(SHARED)
    response = {"beside": "beside/arm.py:height"}.get(place, f"{place}:height")
    plan = load(write(**QUESTION | {"minimize": {"function": response}}))
    assert plan.simulated.objective.history.node == ("left" if place == "beside" else "right")
    (folder / "arm.py").write_text(SHARED.replace('"z"', '"y"'))  # executed again by another load
    assert load(write(**QUESTION)).simulated.objective.history.axis == "y"


def test_files_of_one_stem_are_modules_of_their_own(write, folder):
    law = "class Law(float):\n    pass\n"
    (folder / "arm.py").write_text(law + SHARED)
    (folder / "beside").mkdir()
    (folder / "beside" / "arm.py").write_text(law + SHARED)
    load(write(**QUESTION | {"minimize": {"function": "beside/arm.py:height"}}))
    one, other = (find_function(f"{place}arm.py:build", folder) for place in ("", "beside/"))
    assert one.__module__ != other.__module__
    for function in (one, other):
        law = function.__globals__["Law"]
        assert isinstance(pickle.loads(pickle.dumps(law(2.0))), law)
