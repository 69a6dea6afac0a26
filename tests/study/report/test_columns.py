"""Names of design variables as people read them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torchmbd as mbd
from torchmbd.optimization import Evaluation
from torchmbd.study.report.columns import Columns
from torchmbd.study.sweep import _criteria


def columns(**shapes: tuple[int, ...]) -> Columns:
    own = {name.replace("__", "."): torch.zeros(shape) for name, shape in shapes.items()}
    labels = [f"{name}[{i}]" for name, x in own.items() for i in range(x.numel())]
    kinds = {name: "deg" for name in own if name.endswith("angles")}
    return Columns.of(labels, kinds, [name for name, x in own.items() if not x.ndim])


def test_numbers_tell_the_entries_of_a_parameter_apart():
    result = columns(rod__laminate__angles=(2,), spring__stiffness=())
    assert result.names == ("angle_1_deg", "angle_2_deg", "stiffness")
    assert result.headings == ["angle 1 [deg]", "angle 2 [deg]", "stiffness"]
    assert result.labels == ("rod.laminate.angles[0]", "rod.laminate.angles[1]", "spring.stiffness[0]")
    np.testing.assert_allclose(result.si(np.array([180.0, 90.0, 3.0])), [np.pi, np.pi / 2, 3.0])


def test_the_body_is_named_where_two_share_a_word():
    result = columns(inner__laminate__angles=(1,), outer__laminate__angles=(1,))
    assert result.names == ("inner_angle_1_deg", "outer_angle_1_deg")


def test_parts_of_one_body_are_named_where_they_share_a_word():
    result = columns(arm__inner__thickness=(1,), arm__outer__thickness=(1,), arm__inner__angles=(2,), hub__angles=(1,))
    names = ("arm_inner_thickness_1", "arm_outer_thickness_1", "arm_angle_1_deg", "arm_angle_2_deg", "hub_angle_1_deg")
    assert result.names == names
    x = np.arange(1.0, 6.0)
    assert list(result.by_name(x).values()) == result.in_units(x).tolist()
    assert result.named(x).count("thickness") == 2


@given(st.lists(st.from_regex(r"[ab](\.[ab_]{1,3}){1,2}", fullmatch=True), unique=True, max_size=6), st.integers(0, 2))
def test_every_design_variable_has_a_column_of_its_own(parameters, entries):
    labels = [f"{name}[{i}]" for name in parameters for i in range(entries)] + [f"{name}_1" for name in parameters]
    names = Columns.of(labels, {}).names
    assert len(set(names)) == len(set(labels))


def test_criteria_of_two_bodies_are_named_by_them():
    """In a sweep: constraints on another body than the objective's are criteria of their own."""
    measures = [mbd.Integral(mbd.StrainEnergy(body)) for body in ("inner", "outer")]
    reference = SimpleNamespace(scale=np.ones(1), limits=np.array([2.0]))
    problem = SimpleNamespace(
        stated_objective=measures[0],
        sign=1.0,
        peaks=0,
        constraints=[measures[1] <= 2.0],
        constraint_rows=[slice(0, 1)],
        reference=reference,
    )
    first, other = Evaluation(4.0, np.array([0.0])), Evaluation(2.0, np.array([1.0]))
    result = _criteria(cast(Any, problem), first, [other])
    assert result == {"integral of strain energy of inner": [0.5], "integral of strain energy of outer": [1.5]}
    problem.constraints, problem.constraint_rows = [], []
    assert list(_criteria(cast(Any, problem), first, [other])) == ["integral of strain energy"]


def test_of_several_rows_a_sweep_shows_the_one_that_breaks_the_limit():
    """Values at three times: the least of >=, the largest of <=, the one that deviates most of an equality."""
    height = mbd.AtTimes(mbd.Position("tip", "z"), count=3)
    constraints = [height >= 0.5, height <= 1.0, height.equals(0.6)]
    values = np.array([[0.5, 0.7, 1.0], [0.13, 0.663, 0.5]])  # of the start design, and of another
    rows = [slice(3 * k, 3 * k + 3) for k in range(3)]
    limits, scale = np.repeat([0.5, 1.0, 0.6], 3), np.repeat([-0.5, 1.0, 0.6], 3)
    problem = SimpleNamespace(
        stated_objective=mbd.Mass(),
        sign=1.0,
        peaks=0,
        constraints=constraints,
        constraint_rows=rows,
        reference=SimpleNamespace(limits=limits, scale=scale),
    )
    first, other = (Evaluation(-2.0, (np.tile(v, 3) - limits) / scale) for v in values)
    mass, *shown = _criteria(cast(Any, problem), first, [other]).values()
    assert mass == [-1.0]  # divided by the size of that of the start
    assert np.ravel(shown) == pytest.approx([0.13 / 0.5, 0.663 / 1.0, 0.13 / 1.0])


def test_a_design_is_told_with_names_and_units():
    result = Columns.of(
        ["rod.laminate.angles[0]", "rod.line.length"], {"rod.laminate.angles": "deg", "rod.line.length": "cm"}
    )
    x = np.append(result.si(np.array([-0.001, 71.65951])), 0.5)  # with the extra variable of a min-max problem
    assert result.named(x) == "angle 1 0 deg, length 71.6595 cm"


def test_a_design_of_several_units_names_its_numbers():
    result = Columns.of(["jib.section.radius", "jib.angles[0]"], {"jib.section.radius": "mm", "jib.angles": "deg"})
    assert result.names == ("radius_mm", "angle_1_deg")
    assert result.sentence(np.array([0.012, np.pi / 6])) == "radius 12 mm, angle 1 30 deg"
    assert result.sentence(np.array([0.012])) == "12 mm"


@pytest.mark.parametrize(
    ("parameters", "names"),
    [
        (["push.x", "push.y"], ("push_x", "push_y")),
        (["push.x", "push.y", "pull.x"], ("push_x", "push_y", "pull_x")),  # not y alone
        (["rod.width", "rod.height", "arm.width"], ("rod_width", "rod_height", "arm_width")),
    ],
)
def test_parameters_of_one_part_have_names_of_one_form(parameters, names):
    assert columns(**{name.replace(".", "__"): () for name in parameters}).names == names
