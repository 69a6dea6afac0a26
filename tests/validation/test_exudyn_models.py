"""Mechanisms of the IFToMM library as Exudyn's test models have them, against what those print."""

from __future__ import annotations

import pytest

from tests.validation.exudyn_models import BRICARD, CENTER, COARSE_ENERGY, bricard_norm, four_bar

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.slow
def test_the_four_bar_has_the_printed_center_and_energy():
    """Steps of 10 ms, which are coarse: the same integrator gives the same numbers."""
    tip, error = four_bar(4.0, 400)
    assert [0.5 * float(x) for x in tip[:2]] == pytest.approx(CENTER, abs=2e-6)
    assert error == pytest.approx(COARSE_ENERGY, rel=1e-5)


@pytest.mark.thorough
def test_bricards_mechanism_has_the_printed_norm():
    assert bricard_norm(500, spectral_radius=0.9) == pytest.approx(BRICARD, abs=1e-5)
