"""The arm of three joints with links that bend, against its authors' segments. Needs FLEXIBLE_ARM_MODELS."""

from __future__ import annotations

import pytest

import torchmbd as mbd
from experiments.peers import flexible_arm
from experiments.peers.robots import ARM, folder

pytestmark = [
    pytest.mark.skipif(folder(ARM) is None, reason=f"{ARM} names no folder"),
    pytest.mark.filterwarnings("ignore::UserWarning"),  # limits about a turn apart
]


def test_sag_and_frequency_are_those_of_the_segments():
    """Links bend by an eighth of their reach: displacements of second order are 2 % off, linear ones 5 %."""
    models = folder(ARM)
    assert models is not None
    sag, frequency = {}, {}
    for name, system in (
        ("segments", flexible_arm.segments(models, 5)),
        ("second order", flexible_arm.beams(models)),
        ("linear", flexible_arm.beams(models, stiffening=False)),
    ):
        rest = mbd.equilibrium(system)
        sag[name] = 0.15 - float(flexible_arm.tip(rest)[0, 2])
        frequency[name] = float(rest.frequencies[0, 0])
    for name, tolerance in (("second order", 0.025), ("linear", 0.055)):
        assert sag[name] == pytest.approx(sag["segments"], rel=tolerance)
        assert frequency[name] == pytest.approx(frequency["segments"], rel=tolerance)
