"""Shear forces of thin plates of quadrilaterals: strips under a force, Navier's plate, constant moments on irregular meshes."""

import math

import numpy as np
import pytest
import torch

from tests.fem.elements.plate_cases import GENERAL, centers, freedoms, irregular, solved, stiffness
from tests.fem.elements.test_ply_recovery import constant_state
from tests.validation.navier import Navier
from tests.validation.simply_supported import supports
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import Mesh, rectangle
from torchmbd.math.angles import deg

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
THICK = 1e-3


def shear_forces(matrices: PlateMatrices, laminate: Laminate, u: np.ndarray) -> np.ndarray:
    """Q_x, Q_y [N/m] of all cells."""
    law = laminate.stiffness()
    strains = matrices.section_strains(torch.from_numpy(u.reshape(-1, 6, 1)), law)
    return (law.As @ strains[..., 6:, :])[..., 0].detach().numpy()


@pytest.mark.parametrize("ratio", [1, 3, 12, 50])
@pytest.mark.parametrize("angles", [[0.0], [0.0, 90.0]])
def test_a_strip_under_a_force(ratio, angles):
    """Cells of 1 to 50 times the thickness: the force over the width within 2 % (As gamma: 0.57 to 0.67 of it).

    At the clamp, where the width cannot follow Poisson's ratio, within 8 %.
    """
    laminate = Laminate(CARBON, deg(angles), 0.5 * THICK / len(angles), symmetric=True)
    length, width = 10 * ratio * THICK, 2 * ratio * THICK
    mesh = rectangle(length, width, (10, 2))
    matrices = PlateMatrices(mesh, laminate)
    tip, share = list(mesh.node_set("right_edge")), [0.25, 0.5, 0.25]
    tip.sort(key=lambda node: float(mesh.nodes[node, 1]))
    force = np.zeros(6 * len(mesh.nodes))
    force[np.array(tip) * 6 + 2] = width * np.array(share)
    u = solved(stiffness(matrices, laminate), force, freedoms(mesh.node_set("left_edge"), range(6)))
    column = np.round((centers(mesh)[:, 0].numpy() + length / 2) / (length / 10) - 0.5)
    along = shear_forces(matrices, laminate, u)[:, 0]
    result = np.array([along[column == k].mean() for k in range(10)])
    assert result[2:] == pytest.approx(np.ones(8), rel=0.02)
    assert result[:2] == pytest.approx(np.ones(2), rel=0.085)


def navier_error(mesh: Mesh, laminate: Laminate) -> np.ndarray:
    """Root mean square error of Q_x and Q_y under a sine of pressure, relative to their largest."""
    exact, matrices = Navier(laminate), PlateMatrices(mesh, laminate)
    x, y = (mesh.nodes[:, i].numpy() + 0.5 for i in (0, 1))
    force = np.zeros(6 * len(x))
    force[2::6] = matrices.area.numpy() * np.sin(math.pi * x) * np.sin(math.pi * y)
    u = solved(stiffness(matrices, laminate), force, supports(mesh, exact.support))
    _, _, W, X, Y = np.linalg.solve(exact.term(1, 1), [0, 0, 1, 0, 0])
    (sx, sy), (cx, cy) = (f(math.pi * (centers(mesh)[:, :2].numpy() + 0.5)).T for f in (np.sin, np.cos))
    gamma = np.stack([(math.pi * W + X) * cx * sy, (math.pi * W + Y) * sx * cy], -1)
    expected = gamma @ laminate.stiffness().As.detach().numpy()
    return np.sqrt(((shear_forces(matrices, laminate, u) - expected) ** 2).mean(0)) / np.abs(expected).max(0)


@pytest.mark.parametrize("slenderness", [10, 100, 1000])
@pytest.mark.parametrize(
    ("angles", "symmetric"), [([0], True), ([0, 90], True), ([-45, 45, -45, 45], False), ([0, 90], False)]
)
def test_navier(angles, symmetric, slenderness):
    """At any thickness within 3 %, where As gamma is off by up to 80 %."""
    laminate = Laminate(CARBON, deg(angles), 1.0 / slenderness / len(angles) / (1 + symmetric), symmetric=symmetric)
    assert (navier_error(rectangle(1.0, 1.0, (12, 12)), laminate) < 0.03).all()


def test_irregular_cells():
    """Nodes moved by a tenth of a cell: within 8 %."""
    laminate = Laminate(CARBON, deg([0, 90]), 0.0025, symmetric=True)
    assert (navier_error(irregular(1.0, 1.0, (12, 12), amount=0.1, kind="quad"), laminate) < 0.08).all()


def test_constant_moments_have_no_shear():
    mesh = irregular(0.4, 0.3, (4, 3), kind="quad")
    u = constant_state(mesh).numpy()
    # A moment that vanishes over the length of a cell.
    largest = float(GENERAL.stiffness().D.detach().abs().max()) / 0.1
    assert np.abs(shear_forces(PlateMatrices(mesh, GENERAL), GENERAL, u)).max() < 1e-9 * largest
