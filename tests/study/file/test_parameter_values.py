"""Values of parameters in a file of their own, which an experiment file or an override names."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from torchmbd.errors import InputError

NAME = "rod.laminate.thickness"


def test_a_study_has_the_values_of_the_file_that_it_names(write):
    file = write()
    (file.parent / "thin.yaml").write_text(f"{NAME}: {{value: 0.4, unit: mm}}\n", encoding="utf-8")
    named = write(parameters="thin.yaml")
    for study in (mbd.Study.from_file(named), mbd.Study.from_file(file, "parameters=thin.yaml")):
        assert study.system is not None
        assert study.system.get_parameter(NAME).tolist() == pytest.approx([0.4e-3] * 2)
        assert study.resolved()["parameters"] == {NAME: {"value": 0.4, "unit": "mm"}}


def test_mistakes_have_the_line_of_that_file(write):
    file = write()
    (file.parent / "thin.yaml").write_text("# fitted\nrod.thickness: 0.1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"thin\.yaml, line 2: parameters\.rod\.thickness.*Try:"):
        mbd.Study.from_file(file, "parameters=thin.yaml")
