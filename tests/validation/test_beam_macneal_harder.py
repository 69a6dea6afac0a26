"""The curved and the twisted beam of MacNeal and Harder, by beam elements with sections from finite elements.

R. H. MacNeal, R. L. Harder, A proposed standard set of problems to test finite element accuracy, Finite Elem. Anal.
Des. 1 (1985) 3-20: tip displacements in the direction of a unit force at the tip, by beam theory.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchmbd.fem import sections
from torchmbd.fem.elements import Assembly, BeamLine, Beams
from torchmbd.fem.sections import Orthotropic


def tip(beams: Beams, line: BeamLine, force: list[float]) -> torch.Tensor:
    """Displacement of the last node of a cantilever under a force there."""
    K = Assembly(line, {"beam": beams}, held=[0]).stiffness().dense().detach()
    load = torch.zeros(len(K), dtype=torch.float64)
    load[-6:-3] = torch.tensor(force, dtype=torch.float64)
    return torch.linalg.solve(K, load)[-6:-3]


@pytest.mark.parametrize("elements", [1, 6])
def test_curved_beam(elements):
    """Quarter of a circle, inner radius 4.12, outer 4.32, thickness 0.1, force at the free end: any number of arcs."""
    line = BeamLine.arc(4.22, np.pi / 2, elements)
    section = sections.rectangle(0.1, 0.2, Orthotropic.isotropic(1e7, 0.25, 1.0), cells=(4, 8))
    beams = Beams(line, section, (0.0, 0.0, 1.0))
    assert float(tip(beams, line, [1.0, 0.0, 0.0])[0]) == pytest.approx(0.08734, rel=0.015)
    assert float(tip(beams, line, [0.0, 0.0, 1.0])[2]) == pytest.approx(0.5022, rel=0.015)


@pytest.mark.parametrize(("elements", "ratio"), [(6, 0.9926), (12, 0.9981), (24, 0.9995)])
def test_chords_are_stiffer_than_the_arc(elements, ratio):
    """Out of the plane: exact straight beams along the chords, the share of the polygon in what flat cells miss there."""
    arc, section = (
        BeamLine.arc(4.22, np.pi / 2, elements),
        sections.rectangle(0.1, 0.2, Orthotropic.isotropic(1e7, 0.25, 1.0)),
    )
    chords = BeamLine(arc.nodes, arc.elements)
    result, exact = (tip(Beams(own, section, (0.0, 0.0, 1.0)), own, [0.0, 0.0, 1.0])[2] for own in (chords, arc))
    assert float(result / exact) == pytest.approx(ratio, abs=1e-4)


@pytest.mark.parametrize("elements", [1, 4, 12])
def test_twisted_beam(elements):
    """Length 12, width 1.1, depth 0.32, twisted by 90 degrees from root to tip: any number of twisted elements."""
    line = BeamLine.straight(12.0, elements)
    section = sections.rectangle(1.1, 0.32, Orthotropic.isotropic(29e6, 0.22, 1.0), cells=(10, 4))
    at = np.linspace(0.0, np.pi / 2, elements + 1)
    beams = Beams(line, section, (0.0, 1.0, 0.0), twist=torch.from_numpy(np.stack([at[:-1], at[1:]], axis=1)))
    # at the tip the width (the section's y) points along z: a force along z is in the plane of the width there
    assert float(tip(beams, line, [0.0, 0.0, 1.0])[2]) == pytest.approx(0.005424, rel=0.005)
    assert float(tip(beams, line, [0.0, 1.0, 0.0])[1]) == pytest.approx(0.001754, rel=0.005)
