"""A plate fixed at one node spins about it in its plane at a frequency that falls with the mesh; one fixed on a patch does not.

A moment on a point has no stiffness in plane elasticity: a rigid disk of radius a in a large sheet resists with
4 pi G t a^2 (S. P. Timoshenko, J. N. Goodier, Theory of Elasticity, article 38: rotation of an inner circle), and a node
is a disk of the size of its cells. So the frequency is in proportion to the mesh size; out of plane nothing like it occurs.
"""

import pytest
import torch

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON


def first_in_plane(cells, radius):
    """Lowest frequency [Hz] of motion in the plane, and the lowest one out of it."""
    mesh = mbd.mesh.rectangle(length=0.304, width=0.04, cells=cells, kind="triangle")
    laminate = mbd.Laminate(CARBON, angles=mbd.deg([45, -45, 45]), thickness=2.5e-3 / 3)
    reference = mesh.within(radius) if radius else "center"
    result = mbd.FlexibleBody.plate("rod", mesh, laminate, modes=10, reference=reference).structure()
    values, vectors = torch.linalg.eigh(result["Kr"].detach())
    size = (result["psi"].detach() @ vectors).square().sum(0)  # of the six freedoms [6, modes]
    frequency, flat = values.sqrt() / (2 * torch.pi), size[:2].sum(0) > size[2]
    return float(frequency[flat][0]), float(frequency[~flat][0])


@pytest.mark.thorough
def test_a_node_is_no_support_in_the_plane_but_a_patch_is():
    node, patch = ([first_in_plane(cells, r) for cells in ((24, 4), (48, 8))] for r in (0.0, 0.0135))
    assert node[-1][0] / node[0][0] < 0.6
    assert node[-1][1] == pytest.approx(node[0][1], rel=0.04)
    assert patch[0][0] == pytest.approx(patch[1][0], rel=0.02)
    assert patch[0][1] == pytest.approx(patch[1][1], rel=0.02)
