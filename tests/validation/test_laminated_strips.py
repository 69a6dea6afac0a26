"""Strips of one row of quadrilaterals under an end force in their plane: plies at angles that make their width move.

Timoshenko's beam, P L^3 / 3 E I + 6 P L / 5 G A with the ply's own E and G, where fibers run along or across; meshes eight
times as fine where they slant, since corners of a clamped end have no simple solution then.
"""

import pytest

from experiments.models.shell_problems import cantilever
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.math.angles import deg

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
LONG, WIDE, THICK = 3.0, 0.5, 0.01


def deflection(angles, cells):
    laminate = Laminate(CARBON, deg(angles), THICK / len(angles))
    result = cantilever(lambda s, t: (LONG * s, WIDE * t, 0.0), cells, "quad", laminate, {1: 1.0, 2: 1.0})
    return result["v"], result["w"]


@pytest.mark.thorough
@pytest.mark.parametrize(("angle", "modulus"), [(0, CARBON.E1), (90, CARBON.E2)])
def test_fibers_along_and_across(angle, modulus):
    """6 x 1 cells see less of the shear of a clamped end than is there."""
    exact = 4 * LONG**3 / (modulus * THICK * WIDE**3) + 1.2 * LONG / (CARBON.G12 * THICK * WIDE)
    assert deflection([angle], (6, 1))[0] == pytest.approx(exact, rel=0.035)
    assert deflection([angle], (12, 2))[0] == pytest.approx(exact, rel=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize("angles", [(30,), (45, -45), (0, 45, 90, -45), (20, 70)])
def test_slanted_fibers(angles):
    """In the plane and out of it."""
    fine = deflection(angles, (48, 8))
    for cells, errors in (((6, 1), (0.03, 0.025)), ((12, 2), (0.02, 0.01))):
        for result, limit, error in zip(deflection(angles, cells), fine, errors, strict=True):
            assert result == pytest.approx(limit, rel=error)
