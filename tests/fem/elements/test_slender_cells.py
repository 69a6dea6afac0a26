"""Plates of long cells side by side: their lowest modes are those of the plate, not of rotations at the nodes."""

import numpy as np
import pytest
import torch

from tests.fem.elements.plate_cases import CARBON, frequencies, mapped
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply

THICK = {
    "metal": Laminate(Ply.isotropic(70e9, 0.3, 2700.0), [0.0], 0.1),
    "carbon": Laminate(CARBON, [0.5], 0.1),
}


def free_modes(laminate, cells, kind):
    """Frequencies [Hz] of a free plate of 1 x 0.6 x 0.1, and the part of drilling in the kinetic energy of each mode."""
    plate = PlateMatrices(mapped(cells, lambda s, t: (s, 0.6 * t, 0.0), kind), laminate)
    result, modes = frequencies(plate, laminate, np.array([], dtype=int), 13)
    mass = plate.lumped_mass(laminate.mass_per_area, laminate.rotary_inertia_per_area).numpy()
    return result[6:], (mass[:, None] * modes**2)[5::6, 6:].sum(0)


@pytest.mark.parametrize(("cells", "modes"), [((4, 24), 7), ((40, 2), 5), ((20, 2), 7)])
@pytest.mark.parametrize("material", THICK)
def test_no_drilling_among_the_first_modes(material, cells, modes):
    """Cells of 6 to 12 : 1 that get less drilling stiffness, as a single row needs it, ring at half of these frequencies."""
    laminate = THICK[material]
    result, drilling = free_modes(laminate, cells, "quad")
    assert drilling[:modes].max() < 0.05
    other, _ = free_modes(laminate, cells, "triangle")
    assert result[:modes] == pytest.approx(other[:modes], rel=0.2)


def test_a_single_row_keeps_the_softness_that_bending_needs():
    """Sides of one row are alone: six cells of 5 : 1 under an end force in their plane, beside the beam."""
    laminate = Laminate(Ply.isotropic(1.0, 0.3, 1.0), [0.0], 1.0)
    mesh = mapped((6, 1), lambda s, t: (6.0 * s, 0.2 * t, 0.0), "quad")
    plate = PlateMatrices(mesh, laminate)
    K = plate.stiffness(laminate.entries()).dense()
    tip, root = (torch.as_tensor(mesh.node_set(name)) for name in ("right_edge", "left_edge"))
    load = torch.zeros(len(K), dtype=torch.float64)
    load[6 * tip + 1] = 0.5
    held = (6 * root[:, None] + torch.arange(6)).flatten()
    free = torch.tensor(sorted(set(range(len(K))) - set(held.tolist())))
    u = torch.linalg.solve(K[free][:, free], load[free])
    beam = 6.0**3 / (3 * 0.2**3 / 12) + 6.0 * 1.2 * 2.6 / 0.2
    assert float((load[free] @ u).detach()) == pytest.approx(beam, rel=0.01)
