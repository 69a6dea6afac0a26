"""`key=value`: the same file with one value changed."""

from __future__ import annotations

import pytest

from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.overrides import combinations, override
from torchmbd.study.file.yaml_file import parse_yaml

FILE = """
options: {layers: 3}
design:
  rod.laminate.angles: {start: [45, -45], unit: deg}
subject_to:
  - {at_most: initial}
optimizer:
"""


def changed(*assignments):
    document = parse_yaml(FILE)
    override(document, assignments)
    return document


@pytest.mark.parametrize(
    ("assignment", "keys", "value"),
    [
        ("options.layers=1", ["options", "layers"], 1),
        ("options.name=a=b", ["options", "name"], "a=b"),
        ("design.rod.laminate.angles.start=[1, 2.5]", ["design", "rod.laminate.angles", "start"], [1, 2.5]),
        ("design.rod.laminate.angles.lower=-90", ["design", "rod.laminate.angles", "lower"], -90),
        ("design.bar.laminate.angles.unit=rad", ["design", "bar.laminate.angles", "unit"], "rad"),
        ("subject_to.0.at_most=1e-4", ["subject_to", 0, "at_most"], 1e-4),
        ("subject_to=[]", ["subject_to"], []),
        ("optimizer.max_iterations=2", ["optimizer", "max_iterations"], 2),
        ("simulate.options.rho=0.5", ["simulate", "options", "rho"], 0.5),
    ],
)
def test_an_override_sets_one_value(assignment, keys, value):
    document = changed(assignment)
    data = document.data
    for key in keys:
        data = data[key]
    assert data == value
    assert document.lines[tuple(keys)] == f"override {assignment!r}"
    before = parse_yaml(FILE).data
    assert {key: old for key, old in document.data.items() if key != keys[0]} == {
        key: old for key, old in before.items() if key != keys[0]
    }


def test_later_overrides_win():
    assert changed("options.layers=1", "options.layers=2").data["options"]["layers"] == 2


def test_every_bad_override_is_named_at_once():
    with pytest.raises(StudyError) as caught:
        changed("options", "=3", "subject_to.7.at_most=1", "options.layers.deep=1", "a..b=1", "a=[1", "a=!!int 3")
    assert len(caught.value.faults) == 7
    assert "no such place in a list of 1" in str(caught.value)
    assert "options.layers is the value 3" in str(caught.value)


@pytest.mark.parametrize(
    ("assignments", "studies"),
    [
        ([], [()]),
        (["a=1"], [("a=1",)]),
        (["a=1,2", "b=x, y"], [("a=1", "b=x"), ("a=1", "b=y"), ("a=2", "b=x"), ("a=2", "b=y")]),
        (["a=[1, 2]"], [("a=[1, 2]",)]),
        (["a=[1,2],[3]", "b={c: 1, d: 2}"], [("a=[1,2]", "b={c: 1, d: 2}"), ("a=[3]", "b={c: 1, d: 2}")]),
        (["a='x,y'"], [("a='x,y'",)]),
        (["nothing"], [("nothing",)]),
    ],
)
def test_several_values_are_several_studies(assignments, studies):
    assert combinations(assignments) == studies
