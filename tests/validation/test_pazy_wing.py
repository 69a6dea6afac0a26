"""The Pazy wing (experiments/peers/pazy_wing.py): its deck, its equivalent beam, its measured curves and frequencies."""

import numpy as np
import pytest

from experiments.peers import pazy_wing
from experiments.peers.pazy_wing import GROUND_TEST, ORDER, PRINTED, UM_NAST, UM_NAST_BENT

pytestmark = pytest.mark.extensions  # vibrations, identification, the deck


def test_the_beam_vibrates_as_that_of_another_program():
    """Bending and torsion; in the plane the source's couplings of extension are taken as uniform."""
    ratio = pazy_wing.frequencies() / np.array(UM_NAST)
    assert (np.abs(ratio - 1.0) < [0.005, 0.005, 0.005, 0.005, 0.03]).all()


@pytest.mark.thorough
@pytest.mark.parametrize("mass", UM_NAST_BENT)
def test_the_beam_bends_as_that_of_another_program(mass):
    assert pazy_wing.bent(mass) == pytest.approx(UM_NAST_BENT[mass], rel=1e-3)


@pytest.mark.thorough
def test_measured_curves_and_frequencies_do_not_agree_on_the_root():
    """The curves ask for a soft root, with which the first frequency is too low by 8 %; a clamped one has all but that in the
    plane within 2.5 %. What is held out says so."""
    result = pazy_wing.fit()
    assert result.converged
    low, high = result.interval[0]
    assert 150.0 < low < result["clamp.turning_stiffness_y"] < high < 250.0
    held_out = pazy_wing.frequencies(flap=result["clamp.turning_stiffness_y"])[np.array(ORDER) - 1] / GROUND_TEST
    clamped = pazy_wing.frequencies()[np.array(ORDER) - 1] / GROUND_TEST
    plane = GROUND_TEST.index(60.7)
    assert 0.91 < held_out[0] < 0.93
    assert np.abs(np.delete(clamped, plane) - 1.0).max() < 0.025
    assert clamped[plane] == pytest.approx(1.70, abs=0.01)
    lag = pazy_wing.fit_in_the_plane()["clamp.turning_stiffness_z"]
    hertz = pazy_wing.frequencies(lag=lag)
    assert hertz[plane] == pytest.approx(60.7, rel=1e-6)
    np.testing.assert_allclose(
        np.delete(hertz, plane), np.delete(clamped, plane) * np.delete(GROUND_TEST, plane), rtol=1e-3
    )


@pytest.mark.thorough
@pytest.mark.skipif(pazy_wing.deck() is None, reason="AEPW3_LDWG is not the folder of UM-A2SRL/AePW3-LDWG")
def test_the_deck_is_read_unedited():
    """Five frequencies within 0.2 %. The sixth hangs on rotations of ribs about their normals, which Nastran holds by K6ROT."""
    folder = pazy_wing.deck()
    assert folder is not None
    ratio = pazy_wing.deck_frequencies(folder) / np.array(PRINTED)
    assert (np.abs(ratio - 1.0) < [1e-3, 1e-3, 2e-3, 2e-3, 1e-3, 0.025]).all()
