"""The blade of the IEA 15 MW turbine, where IEA15_RWT is its repository: sections and frequencies beside BeamDyn's table."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from experiments.peers import iea_blade

ROOT = iea_blade.folder()
pytestmark = pytest.mark.skipif(ROOT is None, reason=f"{iea_blade.VARIABLE} is not the repository IEA-15-240-RWT")


@pytest.mark.parametrize(("position", "near"), [(0.0, 5e-3), (0.02, 5e-3), (0.5, 8e-2)])
def test_sections_of_the_file_are_those_of_beamdyn(position: float, near: float):
    assert ROOT is not None
    section = mbd.io.read_windio(ROOT / iea_blade.BLADE).section(position)
    at = torch.tensor([position], dtype=torch.float64)
    table = iea_blade.beamdyn(ROOT)
    K, other = section.stiffness().diagonal(), table.stiffness(at)[0].diagonal()
    assert float((K / other - 1.0).abs().max()) < near
    assert float(section.mass()[0, 0] / table.mass(at)[0, 0, 0] - 1.0) == pytest.approx(0.0, abs=0.04)


def test_frequencies_rise_with_the_speed():
    assert ROOT is not None
    result = iea_blade.beam(ROOT, iea_blade.beamdyn(ROOT), elements=24)
    with torch.no_grad():
        rest, _ = result.frequencies(2)
        spun, _ = result.frequencies(2, spin=(iea_blade.RATED, 0.0, 0.0))
    assert rest.tolist() == pytest.approx([0.507, 0.693], rel=5e-3)
    assert spun.tolist() == pytest.approx([0.531, 0.700], rel=5e-3)
