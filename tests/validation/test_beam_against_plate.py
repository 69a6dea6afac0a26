"""A laminated strip as a beam (2-D section, beam elements) and as a plate (quadrilaterals): two independent chains.

Unbalanced stacks, whose bending twists the strip by a sign that both must agree on.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from torchmbd.fem import sections
from torchmbd.fem.elements import Assembly, BeamLine, Beams, Plates
from torchmbd.fem.reduction import eigenpairs

PLY = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
# Slender, for a beam neglects what varies over a width; thin, for the shear layers at the edges are below the mesh.
LENGTH, WIDTH, HEIGHT = 1.5, 0.02, 4e-4


def parts(degrees: list[float], cells: tuple[int, int]) -> tuple[mbd.Mesh, Plates, BeamLine, Beams]:
    t = HEIGHT / len(degrees)
    mesh = mbd.mesh.rectangle(LENGTH, WIDTH, cells)
    line = BeamLine.straight(LENGTH, cells[0])
    section = sections.strip(WIDTH, PLY, mbd.deg(degrees), t, cells=(16, 2))
    return mesh, Plates(mesh, mbd.Laminate(PLY, mbd.deg(degrees), t), mass="consistent"), line, Beams(line, section)


@pytest.mark.thorough
@pytest.mark.parametrize("degrees", [[30.0], [20.0, -50.0, 75.0]])
def test_frequencies_of_a_free_strip(degrees):
    """Free: a clamped edge would hold the plate's anticlastic bending and shear, which a beam cannot."""
    mesh, plates, line, beams = parts(degrees, (120, 6))
    result = []
    for nodes, part in ((mesh, plates), (line, beams)):
        assembly = Assembly(nodes, {"part": part})
        values = eigenpairs(assembly.stiffness(), assembly.mass(), 10).values.detach().numpy()
        assert np.abs(values[:6]).max() < 1e-4 * values[6]
        result.append(np.sqrt(values[6:]))
    assert np.abs(result[1] / result[0] - 1).max() < 0.01


@pytest.mark.thorough
def test_bending_twists_to_the_same_side():
    """Rotations between a quarter of the length, beyond the reach of the clamped edge, and the tip under a force there."""
    mesh, plates, line, beams = parts([30.0], (80, 4))
    clamped, loaded = mesh.node_set("left_edge"), list(mesh.node_set("right_edge"))
    edge = np.array([0.5, *np.ones(len(loaded) - 2), 0.5]) / (len(loaded) - 1)
    quarter = int(((mesh.nodes - torch.tensor([-LENGTH / 4, 0.0, 0.0], dtype=torch.float64)) ** 2).sum(1).argmin())
    rotations = []
    for nodes, part, held, ends, share, stations in (
        (mesh, plates, clamped, loaded, edge, (quarter, mesh.node("right"))),
        (line, beams, [0], [80], np.ones(1), (20, 80)),
    ):
        assembly = Assembly(nodes, {"part": part}, held)
        force = torch.zeros(6 * len(nodes.nodes), dtype=torch.float64)
        force[[6 * k + 2 for k in ends]] = torch.from_numpy(share)
        u = torch.linalg.solve(assembly.stiffness().dense().detach(), force[assembly.freedoms.free])
        motion = assembly.freedoms.expand(u[:, None])[..., 0]
        rotations.append(motion[stations[1], 3:5] - motion[stations[0], 3:5])
    assert rotations[1].tolist() == pytest.approx(rotations[0].tolist(), rel=0.01)
    assert abs(float(rotations[0][0] / rotations[0][1])) > 0.3  # the coupling is strong
