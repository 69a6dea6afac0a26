"""NAFEMS R0031/1: laminated strip under three-point bending.

Source: NAFEMS, Composites Benchmarks, R0031 (2001), test 1: 0/90/0/90/0/90/0, layers of 0.1 mm but 0.4 mm in the middle,
10 mm wide, supports 30 mm apart, 10 N/mm along the middle line. Targets: bending stress at the outer face under the load
683.9 MPa, shear stress 4.1 MPa at the first interface between support and load, deflection 1.06 mm.
"""

import numpy as np
import pytest
import torch

from tests.elements.plate_cases import freedoms, solved, stiffness
from torchmbd.elements import PlateMatrices, ply_basis, ply_points
from torchmbd.materials import Laminate, Ply
from torchmbd.mesh import Mesh, rectangle
from torchmbd.numerics.angles import deg

PLY = Ply(E1=100e9, E2=5e9, G12=3e9, G13=3e9, G23=2e9, nu12=0.4, density=1.0)
LAMINATE = Laminate(PLY, deg([0, 90, 0, 90, 0, 90, 0]), [1e-4] * 3 + [4e-4] + [1e-4] * 3, shear_correction="energy")


@pytest.fixture(scope="module")
def solution() -> tuple[Mesh, PlateMatrices, np.ndarray]:
    """The strip of 50 x 10 mm with 80 x 16 cells; nodes lie on supports (x = -15, 15 mm) and load (x = 0)."""
    mesh = rectangle(50e-3, 10e-3, (80, 16))
    plate = PlateMatrices(mesh, LAMINATE)
    x, y = mesh.nodes[:, 0].numpy(), mesh.nodes[:, 1].numpy()
    middle = np.flatnonzero(np.abs(x) < 1e-9)
    load = np.zeros(6 * len(x))
    share = np.where(np.abs(np.abs(y[middle]) - 5e-3) < 1e-9, 0.5, 1.0)
    load[6 * middle + 2] = -1e4 * 10e-3 * share / share.sum()
    supports = np.flatnonzero(np.abs(np.abs(x) - 15e-3) < 1e-9)
    center = mesh.node("center")
    held = np.concatenate([freedoms(supports, [2]), freedoms([center], [0, 1, 5])])
    return mesh, plate, solved(stiffness(plate, LAMINATE), load, np.unique(held))


def test_deflection(solution):
    mesh, _, u = solution
    assert -1e3 * u[6 * mesh.node("center") + 2] == pytest.approx(1.06, rel=0.01)


def test_bending_stress_under_the_load(solution):
    """In the cells beside the load, carried on to it along the linear moment: the plate's edge effects are in it."""
    mesh, plate, u = solution
    stress = ply_basis(plate, LAMINATE, torch.from_numpy(u.reshape(-1, 6, 1))).stress[..., 0].detach()
    triangle, layer, face = ply_points(plate, LAMINATE).T
    center = mesh.nodes[mesh.triangles].mean(1)
    near = (center[triangle, 0].abs() < 1e-3) & (center[triangle, 1].abs() < 1e-3) & (layer == 0) & (face == 0)
    outer = (stress[near, 0] / (1.0 - center[triangle[near], 0].abs() / 15e-3)).mean()
    assert 1e-6 * float(outer) == pytest.approx(683.9, rel=0.02)


def test_shear_stress_of_the_first_interface(solution):
    """Mean over the width halfway between support and load (the middle carries 2 % less); continuous between layers."""
    mesh, plate, u = solution
    stress = ply_basis(plate, LAMINATE, torch.from_numpy(u.reshape(-1, 6, 1))).stress[..., 0].detach()
    triangle, layer, face = ply_points(plate, LAMINATE).T
    center = mesh.nodes[mesh.triangles].mean(1)
    between = (center[triangle, 0] + 7.5e-3).abs() < 2e-3
    lower = stress[between & (layer == 0) & (face == 1), 3].mean()  # fibre along x: tau_13 is tau_xz
    upper = stress[between & (layer == 1) & (face == 0), 4].mean()  # fibre along y: tau_23 is -tau_xz
    assert abs(1e-6 * float(lower)) == pytest.approx(4.1, rel=0.02)
    assert float(lower) == pytest.approx(-float(upper), rel=1e-9)
