"""Blades of reference turbines in windIO 1 and 2, where their repositories and the package windIO are: equal sections."""

from __future__ import annotations

import pytest
import torch

from experiments.peers import windio_versions


@pytest.mark.parametrize(
    ("turbine", "position"), [("15", 1 / 49), ("15", 24 / 49), ("15", 39 / 49), ("22", 0.02), ("22", 0.5), ("22", 0.9)]
)
def test_sections_of_both_versions_agree(turbine: str, position: float):
    """To the rounding of the files' arcs, and with the table of version 2 in mass and axial stiffness."""
    paths = windio_versions.files(turbine)
    if paths is None:
        pytest.skip(f"IEA{turbine}_RWT is not the turbine's repository, or the package windIO is not installed")
    (K1, M1), (K2, M2) = (windio_versions.quiet_section(path, position) for path in paths[:2])
    for a, b in ((K1, K2), (M1, M2)):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(a.abs().max()))
    if turbine == "22":
        at, table = torch.tensor([position], dtype=torch.float64), windio_versions.elastic_properties(paths[1])
        assert float(K2[0, 0] / table.stiffness(at)[0, 0, 0]) == pytest.approx(1.0, abs=6e-3)
        assert float(M2[0, 0] / table.mass(at)[0, 0, 0]) == pytest.approx(1.0, abs=1.2e-2)
