"""Section 5.1 on a coarse rod: symmetry, both routes to a sensitivity, files."""

from __future__ import annotations

import pytest

from experiments.paper import figures4_7

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.thorough
def test_figures_are_drawn_and_tell_what_the_header_says(tmp_path, monkeypatch):
    monkeypatch.setattr(figures4_7, "DURATION", 0.02)
    numbers = figures4_7.figures(tmp_path, cells=(6, 2), steps=64)
    assert str(numbers.pop("sentence")).startswith("Fixed modes miss 1")
    assert {file.name for file in tmp_path.iterdir()} == {
        f"{name}.{ending}" for name in figures4_7.FIGURES.values() for ending in ("png", "pdf")
    }
    for layup in (1, 7):  # symmetric about the plane of motion
        assert numbers[f"layup_{layup}_center_sensitivity"] < 1e-8
        assert numbers[f"layup_{layup}_edge_sensitivity"] > 1e-5
    assert numbers["layup_1_edge_fixed_minus_updated"] > 0.5 * numbers["layup_1_edge_sensitivity"]
    assert numbers["layup_7_edge_fixed_minus_updated"] < 0.1 * numbers["layup_1_edge_fixed_minus_updated"]
    for layup in (2, 6):
        errors = {key[-5:]: x for key, x in numbers.items() if key.startswith(f"layup_{layup}_step")}
        assert errors["1e-06"] < 1e-3
        assert errors["1e-03"] == pytest.approx(10 * errors["1e-04"], rel=0.1)  # the order of forward differences
        assert min(errors["1e-01"], errors["1e-12"]) > 100 * min(errors.values())
