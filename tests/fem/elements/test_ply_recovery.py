"""Ply values from nodal displacements: constant states on an irregular mesh in space, against lamination by hand."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.fem.elements.plate_cases import GENERAL, irregular, rotation, turned
from torchmbd.fem.elements import PlateMatrices, ply_basis, ply_points
from torchmbd.fem.mesh import Mesh

EPS = np.array([1e-3, -2e-3, 3e-3])
KAPPA = np.array([0.4, -0.7, 0.5])


def constant_state(mesh: Mesh, eps: np.ndarray = EPS, kappa: np.ndarray = KAPPA) -> torch.Tensor:
    """Displacements [n, 6] of constant eps and kappa without transverse shear, mesh in the x-y plane."""
    x, y = mesh.nodes[:, 0].numpy(), mesh.nodes[:, 1].numpy()
    u = np.zeros((len(x), 6))
    u[:, 0], u[:, 1] = eps[0] * x + eps[2] / 2 * y, eps[1] * y + eps[2] / 2 * x
    u[:, 2] = -(kappa[0] * x**2 + kappa[1] * y**2 + kappa[2] * x * y) / 2
    u[:, 3] = -(kappa[1] * y + kappa[2] / 2 * x)  # phi1 = w,y
    u[:, 4] = kappa[0] * x + kappa[2] / 2 * y  # phi2 = -w,x
    return torch.from_numpy(u)


def by_hand(face: float, theta: float, ply) -> np.ndarray:
    """In-plane stress in ply axes at a height, turning the strain tensor."""
    e = EPS + face * KAPPA
    R = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    own = R.T @ np.array([[e[0], e[2] / 2], [e[2] / 2, e[1]]]) @ R
    return ply.plane_stiffness().numpy() @ np.array([own[0, 0], own[1, 1], 2 * own[0, 1]])


@pytest.mark.parametrize("seed", [None, 5])
def test_constant_strain_and_curvature(seed):
    """Flat, and turned in space together with its material direction; unbalanced and unsymmetric stack."""
    mesh = irregular(0.4, 0.3, (4, 3))
    R = torch.eye(3, dtype=torch.float64) if seed is None else rotation(seed)
    place = turned(mesh, R)
    u = constant_state(mesh).unflatten(-1, (2, 3)) @ R.T
    matrices = PlateMatrices(place, GENERAL, direction=R[:, 0])
    basis = ply_basis(matrices, GENERAL, u.flatten(-2)[..., None])
    points = ply_points(matrices, GENERAL)
    assert basis.stress.shape == (len(points), 5, 1)
    z, angles = GENERAL.faces.detach().numpy(), GENERAL.angles.tolist()
    for point, stress in zip(points.tolist(), basis.stress[..., 0].detach(), strict=True):
        _, layer, face = point
        expected = by_hand(z[layer, face], angles[layer], GENERAL.layer_plies[layer])
        assert stress[:3].tolist() == pytest.approx(expected, rel=1e-9)
        assert float(stress[3:].abs().max()) < 1e-7 * abs(expected).max()


def test_tension_of_an_unsymmetric_strip_bends_it():
    """A solved problem: N_xx on a free rectangle gives the plies of eps, kappa = abd (N, 0) in every triangle."""
    mesh = irregular(0.4, 0.3, (4, 3))
    matrices = PlateMatrices(mesh, GENERAL)
    K = matrices.stiffness(GENERAL.entries()).dense().detach().numpy()
    u = constant_state_of_force(mesh, np.array([1e4, 0, 0, 0, 0, 0]))
    force = (K @ u.ravel()).reshape(-1, 6)
    inner = np.setdiff1d(np.arange(len(mesh.nodes)), mesh.node_set("left_edge") + mesh.node_set("right_edge"))
    assert np.abs(force[inner, :3]).max() < 1e-8 * np.abs(force).max()  # nothing but the ends is loaded
    assert force[list(mesh.node_set("right_edge")), 0].sum() == pytest.approx(1e4 * 0.3, rel=1e-10)
    stress = ply_basis(matrices, GENERAL, torch.from_numpy(u)[..., None]).stress.detach()
    T = GENERAL.thickness.detach()
    per_triangle = stress[..., 0].reshape(len(mesh.triangles), 3, 2, 5)
    own_x = force_in_x(per_triangle)
    assert_close((T * own_x).sum(-1), torch.full((len(mesh.triangles),), 1e4, dtype=torch.float64))


def constant_state_of_force(mesh: Mesh, forces: np.ndarray) -> np.ndarray:
    """Displacements of the constant state under (N, M)."""
    A, B, D, _ = (x.detach().numpy() for x in GENERAL.stiffness())
    strains = np.linalg.solve(np.block([[A, B], [B, D]]), forces)
    return constant_state(mesh, strains[:3], strains[3:]).numpy()


def force_in_x(stress: torch.Tensor) -> torch.Tensor:
    """Mean sig_xx of each layer from ply stresses [..., layers, 2, 5]."""
    c, s = torch.cos(GENERAL.angles.detach()), torch.sin(GENERAL.angles.detach())
    s1, s2, t = stress.mean(-2)[..., :3].unbind(-1)
    return c * c * s1 + s * s * s2 - 2 * c * s * t
