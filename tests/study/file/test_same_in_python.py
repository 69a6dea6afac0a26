"""What a file says and what Python says are the same problem: equal numbers and gradients."""

from __future__ import annotations

import io
import shutil

import numpy as np
import pytest
import yaml
from rich.console import Console

import torchmbd as mbd
from tests.study.rod_model import build
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load_study
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.catalog import children, find
from torchmbd.tracking.mlflow_tracker import MlflowTracker

ANGLES, MASS = "rod.laminate.angles", "slider.mass"
SHORT = {"duration": 0.002, "steps": 8}
ENERGY = mbd.StrainEnergy("rod")
BOX = {ANGLES: mbd.deg([-90, 90]), "rod.laminate.thickness": (1e-3, 5e-3)}
DEGREES = {"start": [45, -45], "lower": -90, "upper": 90, "unit": "deg"}
PLIES = {"start": [3.75, 3.0], "lower": 1, "upper": 5, "unit": "mm"}
NONE = {"optimizer": None, "starts": None, "subject_to": None}


def problem(**given):
    more = {"minimize": mbd.Integral(ENERGY), "variables": [ANGLES], "bounds": BOX[ANGLES]} | given
    return mbd.Problem(build(), 0.002, steps=8, **more)


def same(file, own, x=None):
    """Equal names, boxes, values and gradients, at the start and at another design."""
    asked = load_study(file).problem
    assert asked.names == own.names
    for box in ("start", "lower", "upper"):
        np.testing.assert_allclose(getattr(asked, box), getattr(own, box), rtol=1e-12)
    inside = np.clip(own.start + 0.05 * np.abs(own.start), own.lower, own.upper)
    for a, b in zip(*(one.evaluate(np.stack([own.start, inside]), True) for one in (asked, own)), strict=True):
        for name in vars(b):
            left, right = getattr(a, name), getattr(b, name)
            if isinstance(right, (float, np.ndarray)):
                np.testing.assert_allclose(left, right, rtol=1e-12, err_msg=name)
            else:
                assert left == right
    return asked


@pytest.mark.thorough
def test_maximize(write):
    limit = {"max": {"strain_energy": "rod"}, "at_most": "initial"}
    file = write(
        simulate=SHORT, minimize=None, maximize={"frequency": {"body": "rod", "number": 1}}, subject_to=[limit]
    )
    own = problem(minimize=None, maximize=mbd.Frequency("rod", 1), subject_to=[mbd.Max(ENERGY) <= "initial"])
    asked = same(file, own)
    [result] = asked.evaluate(own.start[None], False)
    assert result.objective == -mbd.Frequency("rod", 1)(own.motion(own.start)).item()
    assert "maximize" in repr(own)


@pytest.mark.thorough
def test_links_of_numbers_in_units(write):
    links = {
        f"{ANGLES}[1]": {f"{ANGLES}[0]": -1.0},
        "rod.laminate.thickness[1]": {"rod.laminate.thickness[0]": 0.5, "constant": 1.25},  # [mm]
    }
    design = {ANGLES: {**DEGREES, "start": 45}, "rod.laminate.thickness": {**PLIES, "start": [3.75]}}
    si = links | {"rod.laminate.thickness[1]": {"rod.laminate.thickness[0]": 0.5, "constant": 1.25e-3}}
    file = write(simulate=SHORT, design=design, links=links, **NONE)
    own = problem(links=si, variables=list(design), bounds=BOX, start=[np.pi / 4, 3.75e-3])
    same(file, own)
    other = design | {"rod.laminate.thickness": {"unit": "mm"}}  # both entries follow, one of them an angle
    links["rod.laminate.thickness[0]"] = {f"{ANGLES}[0]": 0.01, "constant": 3.0}
    links["rod.laminate.thickness[1]"] = {"constant": 3.0}
    si["rod.laminate.thickness[0]"] = {f"{ANGLES}[0]": 1e-5 * 180.0 / np.pi, "constant": 3e-3}
    si["rod.laminate.thickness[1]"] = {"constant": 3e-3}
    file = write(simulate=SHORT, design=other, links=links, **NONE)
    same(file, problem(links=si, variables=list(design), bounds={ANGLES: BOX[ANGLES]}, start=[np.pi / 4]))


@pytest.mark.thorough
def test_a_front(write):
    criteria = {"energy": {"integral": {"strain_energy": "rod"}}, "mass": {"mass": "rod"}}
    design = {ANGLES: DEGREES, "rod.laminate.thickness": PLIES}
    limit = {"max": {"strain_energy": "rod"}, "at_most": 1.0}
    given = {"name": "mmfd", "divisions": 3, "everywhere": False}
    file = write(
        simulate=SHORT,
        design=design,
        minimize=None,
        tradeoff=criteria,
        subject_to=[limit],
        starts=None,
        optimizer=given,
    )
    own = mbd.Tradeoff(
        build(),
        0.002,
        {"energy": mbd.Integral(ENERGY), "mass": mbd.Mass("rod")},
        mbd.Max(ENERGY) <= 1.0,
        variables=list(design),
        bounds=BOX,
        start=[np.pi / 4, -np.pi / 4, 3.75e-3, 3e-3],
        steps=8,
    )
    same(file, own)
    study = load_study(file)
    assert study.front
    assert study.options == {"divisions": 3, "everywhere": False}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["expected", "worst"])
def test_tolerances(write, kind):
    design = {ANGLES: {**DEGREES, "tolerance": [2.5, 0]}}
    file = write(simulate=SHORT, design=design, robust=kind, **NONE)
    own = mbd.optimization.RobustProblem(problem(), mbd.deg([2.5, 0.0]), kind)
    assert same(file, own).kind == kind


@pytest.mark.thorough
def test_the_worst_case_of_what_is_to_be_large(write):
    design = {ANGLES: {**DEGREES, "tolerance": 2.5}}
    first = {"frequency": {"body": "rod", "number": 1}}
    file = write(simulate=SHORT, design=design, minimize=None, maximize=first, robust="worst", **NONE)
    large = problem(minimize=None, maximize=mbd.Frequency("rod", 1))
    own = mbd.optimization.RobustProblem(large, mbd.deg(2.5), "worst")
    same(file, own)
    result = mbd.optimize(own, method="slsqp", max_iterations=15, progress=False)
    around = [e.objective for e in large.evaluate(result.x[:2] + own.shifts, False)]
    assert result.value == pytest.approx(max(around), rel=1e-4)  # beta is the worst of its corners
    assert max(around) < max(e.objective for e in large.evaluate(own.start[:2] + own.shifts, False))


@pytest.mark.thorough
def test_records_have_the_sign_that_was_asked_for(write, empty_store, tmp_path):
    given = {"starts": {"sampler": "sobol", "count": 2, "seed": 7}, "optimizer": {"name": "mmfd", "max_iterations": 2}}
    first = {"frequency": {"body": "rod", "number": 1}}
    links = {f"{ANGLES}[1]": {f"{ANGLES}[0]": -1.0}}
    design = {ANGLES: {**DEGREES, "start": 45}}
    file = write(simulate=SHORT, design=design, links=links, minimize=None, maximize=first, subject_to=None, **given)
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    output, tracker = io.StringIO(), MlflowTracker("large", uri)
    study = load_study(file)
    assert run_study(study, Console(file=output, width=100), tracker) in (0, UNVERIFIED)
    entry = find(uri, "study")
    result = children(uri, entry)
    assert entry.metrics["best_objective"] == -study.outcome.result.best.value > 0.0
    assert [child.metrics["objective"] for child in result] == sorted(
        (c.metrics["objective"] for c in result), reverse=True
    )
    assert entry.metrics["best_objective"] == result[0].metrics["objective"]
    assert entry.metrics["increase_percent"] >= 0.0
    assert "reduction_percent" not in entry.metrics
    assert "more" in output.getvalue()
    assert f"{entry.metrics['best_objective']:.6g}" in output.getvalue()
    assert "No picture" not in output.getvalue()
    loaded = mbd.load(entry.run_id, uri, file.with_name("rod_model.py"))
    assert loaded.x.shape == (1,)
    assert loaded.value == entry.metrics["best_objective"]
    np.testing.assert_allclose(loaded.problem.evaluate(loaded.x[None], False)[0].objective, -loaded.value, rtol=1e-12)


@pytest.mark.thorough
def test_scenarios_with_options_of_the_model(write):
    cases = [{"name": "plain", "set": {"rod.laminate.thickness": 0.004}}, {"options": {"cells": 3, "payload": 0.2}}]
    cases += [{"options": {"payload": 0.2, "cells": 3}, "set": {"rod.laminate.thickness": [0.003, 0.004]}, "weight": 2}]
    file = write(simulate=SHORT, scenarios=cases, combine={"objective": "mean"}, **NONE)
    loaded = build(cells=3, payload=0.2)
    thick = "rod.laminate.thickness"
    own = mbd.Scenarios(
        build(),
        0.002,
        mbd.Integral(ENERGY),
        scenarios={
            "plain": {thick: 0.004},
            "scenario 2": {"system": loaded},
            "scenario 3": {"system": loaded, thick: [0.003, 0.004]},
        },
        weights=[1, 1, 2],
        objective="mean",
        variables=[ANGLES],
        bounds=BOX[ANGLES],
        steps=8,
    )
    asked = same(file, own)
    assert [group.indices for group in asked.groups] == [[0], [1, 2]]
    for wrong, message in (
        ([{"options": {"payloda": 1}}], r"scenarios.0.options.payloda = 1 is not an option: .*Try: 'payload'"),
        (
            [{"options": {"layers": "two"}}],
            r"scenarios.0.options = \{'layers': 'two'\}: the function raised TypeError in",
        ),
        (
            [{"options": {"layers": 3}}],
            r"line \d+: .*scenario .scenario 1. has one of shape \[3\]: 'rod.laminate.angles'",
        ),
        ([{"name": "none"}], r"scenarios.0: sets nothing: must have set, options or both"),
    ):
        with pytest.raises(StudyError, match=message) as error:
            load_study(write(simulate=SHORT, scenarios=wrong, **NONE))
        assert all(isinstance(fault.where, int) for fault in error.value.faults)


LINK = {f"{ANGLES}[1]": {f"{ANGLES}[0]": -1.0}}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        (
            {"minimize": None},
            "minimize is missing: must be a response, such as .*, or instead of it maximize: or tradeoff:",
        ),
        (
            {"maximize": {"mass": "rod"}},
            r"line \d+: maximize and minimize are both given: must not be given together",
        ),
        (
            {"minimize": None, "maximize": {"at_times": {"strain_energy": "rod"}, "times": [0.001, 0.002]}},
            r"line \d+: maximize.*, of 2 rows: must be a measure of one number",
        ),
        ({"robust": "worst"}, r"line \d+: robust = 'worst': must have a variable with a tolerance in design"),
        (
            {"robust": "worse", "design": {ANGLES: {**DEGREES, "tolerance": 1}}},
            r"robust = 'worse': must be one of expected, worst. Try: 'worst'",
        ),
        ({"tradeoff": {"mass": {"mass": "rod"}}, "minimize": None}, r"tradeoff has 1 keys: must have 2 or more"),
        (
            {"tradeoff": {"a": {"mass": "rod"}, "b": {"mass": "rodd"}}, "minimize": None},
            r"line \d+: tradeoff.b.mass: .*'rodd'.*Try: 'rod'",
        ),
        ({"links": {f"{ANGLES}[2]": {f"{ANGLES}[0]": 1.0}}}, r"links.*\[2\] is not an entry of a design variable"),
        (
            {"links": {f"{ANGLES}[1]": {f"{ANGLES}[1]": 1.0}}},
            r"is not an entry, or follows others: must be ",
        ),
        ({"links": {f"{ANGLES}[1]": {"const": 1.0}}}, r"Try: 'constant'"),
        ({"links": {f"{ANGLES}[1]": {}}}, r"links.* must have"),
        ({"links": LINK}, r"start = \[45.0, -45.0\] has 2 values: must have 1"),
        (
            {"links": {f"{ANGLES}[{k}]": {"constant": 1.0} for k in (0, 1)}, "design": {ANGLES: {"unit": "deg"}}},
            r"links leave no entry free",
        ),
        (
            {"links": LINK, "design": {ANGLES: {"unit": "deg"}}},
            rf"line \d+: design.{ANGLES}.lower is missing: must be a number\n.*{ANGLES}.upper is missing",
        ),
        (
            {
                "links": {f"{ANGLES}[{k}]": {"rod.laminate.thickness[0]": 1.0} for k in (0, 1)},
                "design": {ANGLES: {"unit": "deg", "start": 3.0}, "rod.laminate.thickness": PLIES},
            },
            rf"design.{ANGLES}.start = 3.0 is given, but every entry follows others: must be left out",
        ),
    ],
)
def test_what_cannot_be_is_named_with_its_line(write, sections, message):
    file = write(simulate=SHORT, **sections)
    with pytest.raises(StudyError, match=message) as error:
        load_study(file)
    assert all(isinstance(fault.where, int) for fault in error.value.faults)
    assert yaml.safe_load(file.read_text())
