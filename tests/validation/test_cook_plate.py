"""Cook's skew membrane: Felippa's own numbers for OPT, digit by digit, and the converged value.

Sources: R. D. Cook, Improved two-dimensional finite element, J. Struct. Div. ASCE 100 (1974); C. A. Felippa (2003),
table of the skew cantilever: OPT gives 20.56, 22.45, 23.43, 23.80 for 2 x 2 to 16 x 16 cells; reference 23.96.
"""

import numpy as np
import pytest
import torch

from tests.fem.elements.plate_cases import freedoms, mapped, solved, stiffness
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import Mesh


def tip(n):
    """Vertical displacement of the middle of the loaded end; all diagonals fall, drilling free at the clamp."""
    laminate = Laminate(Ply.isotropic(1.0, 1 / 3, 1.0), [0.0], 1.0)
    grid = mapped((n, n), lambda s, t: (48 * s, 44 * s + t * (44 - 28 * s), 0.0))
    i, j = (k.flatten() for k in torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij"))
    a = i * (n + 1) + j
    b, d = a + n + 1, a + 1
    triangles = torch.cat([torch.stack([a, b, d], 1), torch.stack([b, b + 1, d], 1)])
    mesh = Mesh(grid.nodes, triangles, grid.node_sets)
    end = mesh.node_set("right_edge")
    share = np.ones(n + 1)
    share[[0, -1]] = 0.5
    load = np.zeros(6 * len(mesh.nodes))
    load[freedoms(end, [1])] = share / n
    held = np.union1d(freedoms(mesh.node_set("left_edge"), [0, 1]), freedoms(range(len(mesh.nodes)), [2, 3, 4]))
    u = solved(stiffness(PlateMatrices(mesh, laminate), laminate), load, held)
    return u[6 * end[n // 2] + 1]


@pytest.mark.parametrize(("n", "printed"), [(2, 20.56), (4, 22.45), (8, 23.43), (16, 23.80)])
def test_printed_values_of_the_optimal_triangle(n, printed):
    assert tip(n) == pytest.approx(printed, abs=0.006)


@pytest.mark.thorough
def test_converged_value():
    assert tip(32) == pytest.approx(23.96, rel=0.005)
