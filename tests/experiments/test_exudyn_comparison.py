"""The same mechanisms in Exudyn, with the same modes: within a thousandth of each other."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from experiments.models import panel
from experiments.peers import exudyn_peer
from experiments.peers.exudyn_comparison import Comparison, compare
from torchmbd.examples import slider_crank

pytestmark = pytest.mark.usefixtures("compiled")


def agree(found: Comparison) -> None:
    for one, other in (found.peaks, found.integrals):
        assert one == pytest.approx(other, rel=1e-3)
    assert found.place < 1e-3


@pytest.mark.thorough
def test_a_panel_on_three_joints():
    pytest.importorskip("exudyn")
    result = compare(panel.build(cells=(8, 6), modes=4), "panel", "panel", panel.FREE, 0.15, 400)
    agree(result)
    assert result.energy < 1e-3
    assert result.peaks[0] > 0.1


@pytest.mark.slow
def test_the_slider_crank():
    pytest.importorskip("exudyn")
    crank = slider_crank.build(joint="spherical")
    agree(compare(crank, "slider_crank", "rod", "right", slider_crank.DURATION, 1200))


@pytest.mark.thorough
def test_a_rod_that_twists_as_it_bends():
    """One layer at 17 degrees: the same joint at the slider in both codes; with the universal one the peak is 9 % higher."""
    pytest.importorskip("exudyn")
    like = compare(
        slider_crank.build(1, [17.0], kind="quad", joint="spherical"),
        "slider_crank",
        "rod",
        "right",
        slider_crank.DURATION,
        1200,
    )
    agree(like)
    unlike = slider_crank.build(1, [17.0], kind="quad")
    peak = mbd.Max(mbd.StrainEnergy("rod")).value(mbd.simulate(unlike, slider_crank.DURATION, steps=1200))
    assert float(peak) / like.peaks[1] == pytest.approx(1.09, abs=0.01)
    with pytest.raises(mbd.InputError, match=r"must be spherical\. Try: build\(..., joint='spherical'\)"):
        exudyn_peer.slider_crank(unlike, {})
