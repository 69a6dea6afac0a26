"""A clamped plate by lamination parameters: TACS's test_shell_comp_lam_param_full.py.

1 x 1 m, 5 mm, laminate axes at 45 degrees, 0.6 for every parameter (no stack has these, they test formulas), 1 kN along z and
0.1 kN along y at the center, or 10 kPa. TACS prints compliance 16.45700, 112.03682 and the smooth maximum (weight 10, of ten
times the deflection) 0.0468521, 0.1766872 on 10 x 10 of its elements, those of Bathe and Dvorkin (Int. J. Numer. Methods Eng.
21 (1985) 367-383), which are written here once more: with our A, D, As they give TACS's figures. Ours are softer by the error
of that mesh.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.fem.elements.plate_cases import freedoms, solved, stiffness
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials.laminate import strain_rotations

PLY = mbd.Ply(E1=54e9, E2=18e9, G12=9e9, G13=9e9, G23=9e9, nu12=0.25, density=1550.0)
EDGES = ("left_edge", "right_edge", "bottom_edge", "top_edge")
AXIS = (np.sqrt(0.5), np.sqrt(0.5), 0.0)
GAUSS = np.array([-1.0, 1.0]) / np.sqrt(3.0)


def laminate() -> mbd.lamination.LaminationParameters:
    return mbd.lamination.LaminationParameters(PLY, 5e-3, [0.6, 0.0, 0.6, 0.0], [0.6] * 4, checked=False)


def shapes(r: float, s: float) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear functions of a square of side 2 and their slopes [2, 4]."""
    x, y = np.array([-1, 1, 1, -1]), np.array([-1, -1, 1, 1])
    return (1 + r * x) * (1 + s * y) / 4, np.stack([x * (1 + s * y), y * (1 + r * x)]) / 4


def element(D: np.ndarray, As: np.ndarray, h: float) -> np.ndarray:
    """Stiffness of a square of side h by (w, b1, b2): u = z b, gamma = grad w + b, tied at the middles of the sides."""
    K = np.zeros((12, 12))

    def shear(r: float, s: float, axis: int) -> np.ndarray:
        N, dN = shapes(r, s)
        row = np.zeros((4, 3))
        row[:, 0], row[:, 1 + axis] = dN[axis] * 2 / h, N
        return row.ravel()

    for r in GAUSS:
        for s in GAUSS:
            dN = shapes(r, s)[1] * 2 / h
            B = np.zeros((3, 4, 3))
            B[0, :, 1], B[1, :, 2], B[2, :, 1], B[2, :, 2] = dN[0], dN[1], dN[1], dN[0]
            B = B.reshape(3, 12)
            S = np.stack(
                [
                    (1 + s) / 2 * shear(0, 1, 0) + (1 - s) / 2 * shear(0, -1, 0),
                    (1 + r) / 2 * shear(1, 0, 1) + (1 - r) / 2 * shear(-1, 0, 1),
                ]
            )
            K += h**2 / 4 * (B.T @ D @ B + S.T @ As @ S)
    return K


def deflections(n: int, D: np.ndarray, As: np.ndarray) -> list[tuple[float, float]]:
    """Compliance and smooth maximum under the force and under the pressure, by n x n of these elements."""
    h, number = 1.0 / n, np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    places = (3 * cells[:, :, None] + np.arange(3)).reshape(-1, 12)
    K = np.zeros((3 * number.size, 3 * number.size))
    for place in places:
        K[np.ix_(place, place)] += element(D, As, h)
    free = (3 * number[1:-1, 1:-1].ravel()[:, None] + np.arange(3)).ravel()
    force, pressure = np.zeros(3 * number.size), np.zeros(3 * number.size)
    force[3 * number[n // 2, n // 2]] = 1e3
    np.add.at(pressure, 3 * cells.ravel(), 1e4 * h**2 / 4)
    result = []
    for f in (force, pressure):
        u = np.zeros_like(f)
        u[free] = np.linalg.solve(K[np.ix_(free, free)], f[free])
        w = 10.0 * np.stack([shapes(r, s)[0] for r in GAUSS for s in GAUSS]) @ u[3 * cells.T]
        smooth = w.max() + np.log((h**2 / 4 * np.exp(10.0 * (w - w.max()))).sum()) / 10.0
        result.append((float(f @ u), float(smooth)))
    return result


@pytest.mark.thorough
def test_plate_of_tacs():
    X = laminate().stiffness()
    T, R = (x[0] for x in strain_rotations(torch.full((1,), np.pi / 4, dtype=torch.float64)))
    D, As = ((turn.T @ own @ turn).detach().numpy() for turn, own in ((T, X.D), (R, X.As)))
    A = (T.T @ X.A @ T).detach().numpy()
    (force, high), (pressure, highest) = deflections(10, D, As)
    in_plane = membrane(A)
    assert force + in_plane == pytest.approx(16.45700369546179, rel=1e-6)  # TACS has drilling stiffness in the plane
    assert pressure == pytest.approx(112.03681803257064, rel=1e-7)
    assert (high, highest) == pytest.approx((0.046852109681568097, 0.17668717737166387), rel=1e-6)
    fine = deflections(28, D, As)
    for (own, smooth), (compliance, other) in zip(ours(40), fine, strict=True):
        assert own == pytest.approx(compliance, rel=1.2e-2)
        assert smooth == pytest.approx(other, rel=1.2e-2)


def membrane(A: np.ndarray) -> float:
    """Compliance of 0.1 kN along y in the plane, 10 x 10 bilinear elements."""
    n = 10
    h, number = 1.0 / n, np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    own = np.zeros((8, 8))
    for r in GAUSS:
        for s in GAUSS:
            dN = shapes(r, s)[1] * 2 / h
            B = np.zeros((3, 4, 2))
            B[0, :, 0], B[1, :, 1], B[2, :, 0], B[2, :, 1] = dN[0], dN[1], dN[1], dN[0]
            B = B.reshape(3, 8)
            own += h**2 / 4 * B.T @ A @ B
    K = np.zeros((2 * number.size, 2 * number.size))
    for place in (2 * cells[:, :, None] + np.arange(2)).reshape(-1, 8):
        K[np.ix_(place, place)] += own
    free = (2 * number[1:-1, 1:-1].ravel()[:, None] + np.arange(2)).ravel()
    f = np.zeros(len(K))
    f[2 * number[n // 2, n // 2] + 1] = 1e2
    return float(f[free] @ np.linalg.solve(K[np.ix_(free, free)], f[free]))


def ours(n: int) -> list[tuple[float, float]]:
    """Compliance and smooth maximum by n x n of our quadrilaterals."""
    mesh, own = mbd.mesh.rectangle(1.0, 1.0, (n, n), "quad"), laminate()
    plate = PlateMatrices(mesh, own, direction=AXIS)
    held = np.unique(np.concatenate([freedoms(mesh.node_set(edge), range(6)) for edge in EDGES]))
    force, pressure = np.zeros((2, 6 * len(mesh.nodes)))
    force[6 * mesh.node("center") + np.array([1, 2])] = 1e2, 1e3
    area = plate.area.numpy()
    pressure[2::6] = 1e4 * area
    result = []
    for f in (force, pressure):
        u = solved(stiffness(plate, own), f, held)
        w = 10.0 * u[2::6]
        result.append((float(f @ u), float(w.max() + np.log((area * np.exp(10.0 * (w - w.max()))).sum()) / 10.0)))
    return result
