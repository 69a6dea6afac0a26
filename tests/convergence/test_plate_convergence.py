"""Rate and level of both elements: error against the exact series under refinement, thick and thin, coupled or not.

The rate is 2 (error ~ size^2) in deflection and frequency alike: linear rotations when thick, quadratic ones when thin,
lumped mass. It is measured from 16 to 32 cells. Where the element size passes the shear length (a/h = 100 here) the
leading error changes its constant on the way, so only the level is asked. With quadrilaterals most of the error is that of
loads and masses lumped at the nodes, the same at any thickness and stack.
"""

import math

import pytest

from tests.validation.navier import Navier
from tests.validation.simply_supported import center_deflection, plate_frequencies
from torchmbd.materials import Laminate, Ply
from torchmbd.numerics.angles import deg

PAGANO = Ply(E1=25.0, E2=1.0, G12=0.5, G13=0.5, G23=0.2, nu12=0.25, density=1.0)
STACKS = {
    "isotropic": lambda h: Laminate(Ply.isotropic(1.0, 0.3, 1.0), [0.0], h),
    "0/90": lambda h: Laminate(PAGANO, deg([0, 90]), h / 2),
    "45/-45": lambda h: Laminate(PAGANO, deg([45, -45]), h / 2),
}


#: Errors allowed at 16 and at 32 cells a side.
LEVELS = {"triangle": (5e-3, 1e-3), "quad": (7.5e-3, 2e-3)}


def errors(laminate, kind):
    """Relative errors of deflection (sine load) and first frequency with 16 and 32 cells a side."""
    exact = Navier(laminate)
    w, f = exact.sine_deflection(), exact.frequencies(1)[0]
    support = exact.support
    deflection = [abs(center_deflection(laminate, (n, n), support, load="sine", kind=kind) / w - 1) for n in (16, 32)]
    frequency = [abs(plate_frequencies(laminate, (n, n), support, 1, kind=kind)[0] / f - 1) for n in (16, 32)]
    return deflection, frequency


@pytest.mark.parametrize("kind", LEVELS)
@pytest.mark.parametrize(
    ("stack", "slenderness"),
    [
        ("isotropic", 4),
        ("isotropic", 10),
        ("isotropic", 1000),
        ("0/90", 4),
        ("0/90", 1000),
        ("45/-45", 1000),
    ],
)
def test_rate_is_two(stack, slenderness, kind):
    for coarse, fine in errors(STACKS[stack](1 / slenderness), kind):
        assert fine < LEVELS[kind][1]
        if fine > 1e-4:  # of thin angle-ply quadrilaterals loads and elements cancel to less
            assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("kind", LEVELS)
@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("slenderness", [4, 10, 30, 100, 300, 1000])
def test_no_locking_at_any_thickness(stack, slenderness, kind):
    """16 cells a side: half a percent in deflection from a/h = 4 to 1000; quadrilaterals 0.75."""
    laminate = STACKS[stack](1 / slenderness)
    exact = Navier(laminate)
    found = center_deflection(laminate, (16, 16), exact.support, load="sine", kind=kind)
    assert found == pytest.approx(exact.sine_deflection(), rel=LEVELS[kind][0])
