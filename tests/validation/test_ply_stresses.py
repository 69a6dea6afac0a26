"""Ply stresses of simply supported plates under a sine: Reddy's printed first-order results, the series, the triangle.

Source: J. N. Reddy, A simple higher-order theory for laminated composite plates, J. Appl. Mech. 51 (1984) 745-752,
table 1, first-order rows (0/90/90/0, K = 5/6): stresses times h^2 / (q a^2) in plate axes.
"""

import math

import numpy as np
import pytest
import torch

from tests.fem.elements.plate_cases import centers, solved, stiffness
from tests.validation.navier import Navier
from tests.validation.simply_supported import supports
from torchmbd.fem.elements import PlateMatrices, ply_basis, ply_points
from torchmbd.fem.materials import Laminate, Ply, ply_maps
from torchmbd.fem.mesh import rectangle
from torchmbd.math.angles import deg

PAGANO = Ply(E1=25.0, E2=1.0, G12=0.5, G13=0.5, G23=0.2, nu12=0.25, density=1.0)
#: a/h, sig_xx at the top face, sig_yy at the upper interface to the 0 degree layer (both at the center), tau_xy at a corner
PRINTED = [(4, 0.4059, 0.5765, 0.0308), (10, 0.4989, 0.3615, 0.0241), (20, 0.5273, 0.2957, 0.0221)]


def stack(slenderness: float) -> Laminate:
    return Laminate(PAGANO, deg([0, 90]), 0.25 / slenderness, symmetric=True, shear_correction=5 / 6)


def series_amplitudes(laminate: Laminate) -> np.ndarray:
    """Plate strains per sine or cosine of the term (1, 1) under the pressure sin sin of 1 Pa (SS-1)."""
    U, V, W, X, Y = np.linalg.solve(Navier(laminate).term(1, 1), [0, 0, 1, 0, 0])
    k = math.pi
    return np.array([-k * U, -k * V, k * (U + V), -k * X, -k * Y, k * (X + Y), k * W + X, k * W + Y])


@pytest.mark.parametrize(("slenderness", "xx", "yy", "xy"), PRINTED)
def test_printed_stresses(slenderness, xx, yy, xy):
    laminate = stack(slenderness)
    stress = (ply_maps(laminate).stress.detach().numpy() * series_amplitudes(laminate)).sum(-1) / slenderness**2
    assert stress[3, 1, 0] == pytest.approx(xx, rel=2e-3)  # top face: the fibre lies along x
    assert stress[2, 1, 0] == pytest.approx(yy, rel=2e-3)  # top of the upper 90 degree layer: fibre along y
    assert abs(stress[3, 1, 2]) == pytest.approx(xy, rel=5e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["triangle", "quad"])
@pytest.mark.parametrize("slenderness", [4, 20])
def test_ply_stresses_of_the_elements_converge_to_the_series(slenderness, kind):
    """Every component, in every cell, layer and face: within 1.5 % of its largest at 32 x 32 cells."""
    laminate = stack(slenderness)
    errors = [field_error(laminate, n, kind) for n in (16, 32)]
    assert (errors[1] < 0.015).all()
    assert (errors[0] / errors[1] > 1.8).all()


def field_error(laminate: Laminate, n: int, kind: str) -> np.ndarray:
    """Root mean square error of the five stresses at all points, relative to the largest stress of the component."""
    mesh = rectangle(1.0, 1.0, (n, n), kind)
    matrices = PlateMatrices(mesh, laminate)
    x, y = (mesh.nodes[:, i].numpy() + 0.5 for i in (0, 1))
    force = np.zeros(6 * len(x))
    force[2::6] = matrices.area.numpy() * np.sin(math.pi * x) * np.sin(math.pi * y)
    u = solved(stiffness(matrices, laminate), force, supports(mesh, "SS-1"))
    result = ply_basis(matrices, laminate, torch.from_numpy(u.reshape(-1, 6, 1))).stress[..., 0].detach().numpy()
    cell, layer, face = ply_points(matrices, laminate).T.numpy()
    center = centers(mesh).numpy()[:, :2] + 0.5
    (sx, sy), (cx, cy) = np.sin(math.pi * center).T, np.cos(math.pi * center).T
    shapes = np.stack([sx * sy, sx * sy, cx * cy, sx * sy, sx * sy, cx * cy, cx * sy, sx * cy], -1)
    maps = ply_maps(laminate).stress.detach().numpy()
    exact = np.einsum("pcs,ps->pc", maps[layer, face], shapes[cell] * series_amplitudes(laminate))
    return np.sqrt(((result - exact) ** 2).mean(0)) / np.abs(exact).max(0)
