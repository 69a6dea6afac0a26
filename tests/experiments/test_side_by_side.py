"""The same mechanisms in Exudyn, with the same modes: within a thousandth of each other."""

from __future__ import annotations

import pytest

from experiments import panel, slider_crank
from experiments.side_by_side import Comparison, compare


def agree(found: Comparison) -> None:
    for one, other in (found.peaks, found.integrals):
        assert one == pytest.approx(other, rel=1e-3)
    assert found.place < 1e-3


def test_a_panel_on_three_joints():
    pytest.importorskip("exudyn")
    found = compare(panel.build(cells=(8, 6), modes=4), "panel", "panel", panel.FREE, 0.15, 400)
    agree(found)
    assert found.energy < 1e-3
    assert found.peaks[0] > 0.1


@pytest.mark.slow
def test_the_slider_crank():
    pytest.importorskip("exudyn")
    agree(compare(slider_crank.build(), "slider_crank", "rod", "right", slider_crank.DURATION, 1200))
