"""Figs. 8-11 on a coarse rod: the minima that they have, files."""

from __future__ import annotations

import pytest

from experiments.paper import figures8_11

pytestmark = pytest.mark.usefixtures("compiled")


def test_figures_are_drawn_and_tell_their_minima(tmp_path):
    result = figures8_11.figures(tmp_path, cells=(4, 2), modes=2, steps=96, increment=15.0, max_iterations=1)
    names = {f"figure{k}.{ending}" for k in (8, 9, 10, 11) for ending in ("png", "pdf")}
    assert {file.name for file in tmp_path.iterdir()} == names
    assert str(result["figure8_minima"]).startswith("0 deg (0.")
    assert "," not in str(result["figure8_minima"])  # the only one
    assert result["figure9_peak_least_peak"] < result["figure9_peak_start_design"]
    assert result["figure10_integral_of_2U"] < 1.0
    assert "Minima over the angle" in str(result["sentence"])
