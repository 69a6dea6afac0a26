"""T300/5208 carbon-epoxy at 0, 45 and 90 degrees: the stiffness table of Tsai and Hahn.

Source: S. W. Tsai and H. T. Hahn, Introduction to Composite Materials (1980), tables 1.7, 3.3 and 3.6 (GPa).
"""

import pytest

from torchmbd.fem.materials import IsotropicMean, Laminate, Ply
from torchmbd.math.angles import deg

T300 = Ply(E1=181e9, E2=10.3e9, G12=7.17e9, G13=7.17e9, G23=7.17e9, nu12=0.28, density=1600.0)


@pytest.mark.parametrize(
    ("degrees", "Q11", "Q22", "Q12", "Q66", "Q16", "Q26"),
    [
        (0, 181.8, 10.34, 2.897, 7.17, 0.0, 0.0),
        (15, 160.4, 11.97, 12.75, 17.03, 38.50, 4.36),
        (30, 109.3, 23.65, 32.46, 36.73, 54.19, 20.05),
        (45, 56.65, 56.65, 42.32, 46.59, 42.87, 42.87),
        (-45, 56.65, 56.65, 42.32, 46.59, -42.87, -42.87),
        (90, 10.34, 181.8, 2.897, 7.17, 0.0, 0.0),
    ],
)
def test_off_axis_stiffness(degrees, Q11, Q22, Q12, Q66, Q16, Q26):
    A = Laminate(T300, deg([degrees]), 1e-3).stiffness().A.detach() / 1e6
    expected = [Q11, Q22, Q12, Q66, Q16, Q26]
    result = [A[0, 0], A[1, 1], A[0, 1], A[2, 2], A[0, 2], A[1, 2]]
    assert [float(x) for x in result] == pytest.approx(expected, abs=0.06, rel=1e-3)


def test_invariants():
    """U1 = 76.37 GPa and U4 = 22.61 GPa, so the mean Poisson's ratio is 0.296."""
    assert IsotropicMean.of(Laminate(T300, deg([17, -63]), 1e-3)).poisson == pytest.approx(22.61 / 76.37, rel=3e-4)
