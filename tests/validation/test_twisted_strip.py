"""Torsion of a thick strip: shear that changes within the thickness of its edges, on cells from square to slender.

First-order plate theory with free edges, warping free:  J = b h^3 / 3 (1 - tanh(s) / s),  s = b / h sqrt(5 / 2), 0.685 of
Kirchhoff's b h^3 / 3 for b = 2 h; the solution with w = theta' x y, beta_x = -theta' f(y), beta_y = -theta' x of the
equations of E. Reissner, The effect of transverse shear deformation on the bending of elastic plates, J. Appl. Mech. 12
(1945).
"""

import math

import numpy as np
import pytest

from tests.elements.plate_cases import freedoms, solved, stiffness
from torchmbd.elements import PlateMatrices
from torchmbd.materials import Laminate, Ply
from torchmbd.mesh import rectangle

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


@pytest.mark.parametrize(
    ("kind", "slenderness", "errors"),
    [
        ("triangle", 1.0, (0.09, 0.026)),
        ("triangle", 2.5, (0.18, 0.06)),
        ("triangle", 5.0, (0.26, 0.11)),
        ("quad", 1.0, (0.05, 0.014)),
        ("quad", 2.5, (0.045, 0.013)),
        ("quad", 5.0, (0.042, 0.012)),
    ],
)
def test_torsional_stiffness(kind, slenderness, errors):
    """4 and 8 cells across; from 8 to 16 the error falls to less than a third."""
    found = [torsional_stiffness(n, slenderness, kind) / EXACT - 1 for n in (4, 8, 16)]
    assert found[0] == pytest.approx(0.0, abs=errors[0])
    assert found[1] == pytest.approx(0.0, abs=errors[1])
    assert 0.0 < found[2] < found[1] / 3
