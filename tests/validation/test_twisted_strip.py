"""Torsion of a thick strip: shear that changes within the thickness of its edges, on cells from square to slender.

First-order plate theory with free edges, warping free:  J = b h^3 / 3 (1 - tanh(s) / s),  s = b / h sqrt(5 / 2), 0.685 of
Kirchhoff's b h^3 / 3 for b = 2 h; the solution with w = theta' x y, beta_x = -theta' f(y), beta_y = -theta' x of the
equations of E. Reissner, The effect of transverse shear deformation on the bending of elastic plates, J. Appl. Mech. 12
(1945).
"""

import math

import numpy as np
import pytest

from tests.fem.elements.plate_cases import freedoms, solved, stiffness
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import rectangle

LENGTH, B, H, E, NU = 2.0, 0.2, 0.1, 1e7, 0.25
S = B / H * math.sqrt(2.5)
EXACT = E / 2 / (1 + NU) * B * H**3 / 3 * (1 - math.tanh(S) / S)


def torsional_stiffness(across: int, slenderness: float, kind: str) -> float:
    """G J from the energy of a unit twist; cells `slenderness` times as long as wide."""
    mesh = rectangle(LENGTH, B, (max(1, round(LENGTH / (B / across * slenderness))), across), kind)
    laminate = Laminate(Ply.isotropic(E, NU, 1.0), [0.0], H)
    x, y, _ = mesh.nodes.numpy().T
    given = np.zeros((len(x), 6))
    given[:, 2], given[:, 3] = x * y, x
    ends = (*mesh.node_set("left_edge"), *mesh.node_set("right_edge"))
    held = np.union1d(freedoms(range(len(x)), [0, 1, 5]), freedoms(ends, [2, 3]))
    K = stiffness(PlateMatrices(mesh, laminate), laminate)
    u = solved(K, np.zeros(6 * len(x)), held, given.ravel())
    return u @ K @ u / LENGTH


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "slenderness", "errors"),
    [
        ("triangle", 1.0, (0.09, 0.026)),
        ("triangle", 2.5, (0.18, 0.06)),
        ("triangle", 5.0, (0.26, 0.11)),
        ("quad", 1.0, (0.0225, 0.01)),
        ("quad", 2.5, (0.0185, 0.0095)),
        ("quad", 5.0, (0.016, 0.0085)),
    ],
)
def test_torsional_stiffness(kind, slenderness, errors):
    """4 and 8 cells across; from 8 to 16 the error falls to less than a third."""
    result = [torsional_stiffness(n, slenderness, kind) / EXACT - 1 for n in (4, 8, 16)]
    assert result[0] == pytest.approx(0.0, abs=errors[0])
    assert result[1] == pytest.approx(0.0, abs=errors[1])
    assert 0.0 < result[2] < result[1] / 3


@pytest.mark.parametrize(("across", "error"), [(1, 0.035), (2, 0.01)])
def test_long_quadrilaterals_know_the_layer_at_a_free_edge(across, error):
    """Cells 5 : 1 as wide as the layers or wider; with shear that runs linearly over them 0.14 and 0.13."""
    assert torsional_stiffness(across, 5.0, "quad") == pytest.approx(EXACT, rel=error)


@pytest.mark.parametrize("cells", [(8, 1), (6, 2), (12, 4)])
def test_edges_do_not_touch_constant_shear(cells):
    """A thick strip under an end force is Timoshenko's beam, with any number of rows; shear has 2.3 % of the deflection."""
    mesh = rectangle(1.0, 0.4, cells, "quad")
    laminate = Laminate(Ply.isotropic(1.0, 0.0, 1.0), [0.0], 0.2)
    load = np.zeros(6 * len(mesh.nodes))
    end = mesh.node_set("right_edge")
    share = np.ones(len(end))
    share[[0, -1]] = 0.5
    load[freedoms(end, [2])] = share / share.sum()
    K = stiffness(PlateMatrices(mesh, laminate), laminate)
    result = load @ solved(K, load, freedoms(mesh.node_set("left_edge")))
    bending, shear = 4.0 / (0.4 * 0.2**3), 2.0 / (0.4 * 0.2) * 1.2
    assert result == pytest.approx(bending + shear, rel=5e-4)
