"""Rate and level of both elements: error against the exact series under refinement, thick and thin, coupled or not.

The rate is 2 (error ~ size^2) in deflection and frequency alike: linear rotations when thick, quadratic ones when thin,
lumped mass. It is measured from 16 to 32 cells. Where the element size passes the shear length (a/h = 100 to 1000 here) the
leading error changes its constant on the way, so only the level is asked. Loads lumped at the nodes bend a plate more than
quadrilaterals err, so these are loaded by what bilinear functions take of the sine.
"""

import math

import pytest

from tests.validation.navier import Navier
from tests.validation.simply_supported import center_deflection, plate_frequencies
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.math.angles import deg

PAGANO = Ply(E1=25.0, E2=1.0, G12=0.5, G13=0.5, G23=0.2, nu12=0.25, density=1.0)
STACKS = {
    "isotropic": lambda h: Laminate(Ply.isotropic(1.0, 0.3, 1.0), [0.0], h),
    "0/90": lambda h: Laminate(PAGANO, deg([0, 90]), h / 2),
    "45/-45": lambda h: Laminate(PAGANO, deg([45, -45]), h / 2),
}


#: Errors allowed at 16 and at 32 cells a side: of deflections and of frequencies (masses are lumped).
LEVELS = {"triangle": ((5e-3, 1e-3), (5e-3, 1e-3)), "quad": ((4e-3, 1e-3), (5e-3, 2e-3))}


def sine_deflection(laminate, n, support, kind):
    """Center under a sine load, n cells a side: lumped loads, less what bilinear functions do not take of them."""
    turn = math.pi / n
    taken = (2 * (1 - math.cos(turn)) / turn**2) ** 2 if kind == "quad" else 1.0
    return taken * center_deflection(laminate, (n, n), support, load="sine", kind=kind)


def fall(errors, level):
    """Errors at 16 and 32 cells are below their levels and a quarter of each other."""
    coarse, fine = (abs(error) for error in errors)
    assert coarse < level[0]
    assert fine < level[1]
    assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", LEVELS)
@pytest.mark.parametrize("slenderness", [4, 10_000])
@pytest.mark.parametrize("stack", STACKS)
def test_deflections_have_rate_two(stack, slenderness, kind):
    laminate = STACKS[stack](1 / slenderness)
    exact = Navier(laminate)
    w = exact.sine_deflection()
    fall([sine_deflection(laminate, n, exact.support, kind) / w - 1 for n in (16, 32)], LEVELS[kind][0])


@pytest.mark.thorough
@pytest.mark.parametrize("kind", LEVELS)
@pytest.mark.parametrize(
    ("stack", "slenderness"), [("isotropic", 4), ("isotropic", 1000), ("0/90", 4), ("0/90", 1000), ("45/-45", 4)]
)
def test_frequencies_have_rate_two(stack, slenderness, kind):
    """Not of thinner plates: unsymmetric ones lose digits that the levels need."""
    laminate = STACKS[stack](1 / slenderness)
    exact = Navier(laminate)
    f = exact.frequencies(1)[0]
    result = [plate_frequencies(laminate, (n, n), exact.support, 1, kind=kind)[0] / f - 1 for n in (16, 32)]
    fall(result, LEVELS[kind][1])


@pytest.mark.parametrize("kind", LEVELS)
@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("slenderness", [4, 10, 30, 100, 300, 1000])
def test_no_locking_at_any_thickness(stack, slenderness, kind):
    """16 cells a side: half a percent in deflection from a/h = 4 to 1000; quadrilaterals 0.4."""
    laminate = STACKS[stack](1 / slenderness)
    exact = Navier(laminate)
    result = sine_deflection(laminate, 16, exact.support, kind)
    assert result == pytest.approx(exact.sine_deflection(), rel=LEVELS[kind][0][0])
