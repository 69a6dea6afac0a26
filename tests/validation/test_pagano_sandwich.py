"""Sandwich and cross-ply plates under a sine against three-dimensional elasticity: what the shear correction is for.

Source: N. J. Pagano, Exact solutions for rectangular bidirectional composites and sandwich plates, J. Compos. Mater. 4
(1970) 20-34: 100 w E2 h^3 / (q a^4) at the center of a square sandwich, faces of 0.1 h, and of 0/90/90/0 (E2 of the faces).
"""

import pytest

from tests.validation.navier import Navier
from tests.validation.simply_supported import center_deflection
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.math.angles import deg

FACE = Ply(E1=25.0, E2=1.0, G12=0.5, G13=0.5, G23=0.2, nu12=0.25, density=1.0)
CORE = Ply(E1=0.04, E2=0.04, G12=0.016, G13=0.06, G23=0.06, nu12=0.25, density=0.1)


def sandwich(slenderness, correction="energy"):
    h = 1.0 / slenderness
    return Laminate([FACE, CORE, FACE], [0.0] * 3, [0.1 * h, 0.8 * h, 0.1 * h], shear_correction=correction)


def scaled(laminate, slenderness):
    return 100 * Navier(laminate).sine_deflection() / slenderness**3


@pytest.mark.parametrize(
    ("slenderness", "exact", "error", "error_of_five_sixths"),
    [(4, 7.5962, 0.035, -0.37), (10, 2.2004, 0.006, -0.29), (20, 1.2264, 1.5e-3, -0.14), (100, 0.8923, 3e-4, -0.008)],
)
def test_sandwich(slenderness, exact, error, error_of_five_sixths):
    """The stiffness of equal energy brings first-order theory to the exact solution; 5/6 of the sum does not."""
    assert scaled(sandwich(slenderness), slenderness) == pytest.approx(exact, rel=error)
    assert scaled(sandwich(slenderness, 5 / 6), slenderness) / exact - 1 == pytest.approx(
        error_of_five_sixths, abs=0.01
    )


@pytest.mark.parametrize(
    ("slenderness", "exact", "error"), [(10, 0.743, 0.004), (20, 0.517, 0.008), (100, 0.4347, 5e-4)]
)
def test_cross_ply(slenderness, exact, error):
    """0/90/90/0, where 5/6 is 10.8 % too stiff at a/h = 10 (test_reddy_laminated_plates.py)."""
    laminate = Laminate(FACE, deg([0, 90]), 0.25 / slenderness, symmetric=True)
    assert scaled(laminate, slenderness) == pytest.approx(exact, rel=error)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["triangle", "quad"])
@pytest.mark.parametrize("slenderness", [4, 10, 100])
def test_the_elements_on_a_sandwich(slenderness, kind):
    """The mean of isotropic plies gives the elements their shear length: 1 % of the series, 24 x 24 cells, soft core or not."""
    laminate = sandwich(slenderness)
    series = Navier(laminate).sine_deflection()
    assert center_deflection(laminate, (24, 24), "SS-1", load="sine", kind=kind) == pytest.approx(series, rel=0.01)
