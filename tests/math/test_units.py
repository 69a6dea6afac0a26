"""Units by name: their multiples, and what parameters are measured in."""

from __future__ import annotations

import math

import pytest

import torchmbd as mbd
from tests.refused import refused
from torchmbd.math.units import UNITS, factor, in_si, misfit


@pytest.mark.parametrize(
    ("name", "si"),
    [("deg", math.pi / 180), ("cm", 0.01), ("in", 0.0254), ("ft", 12 * 0.0254), ("lb", 0.45359237), ("g/cm3", 1000.0)],
)
def test_multiples(name, si):
    assert factor(name) == pytest.approx(si, rel=1e-15)


def test_pounds_per_square_inch():
    assert factor("psi") == pytest.approx(6894.757293168, rel=1e-12)
    assert {UNITS[name][1] for name in ("Pa", "kPa", "MPa", "GPa", "psi")} == {"Pa"}


def test_a_text_with_a_unit_has_the_number_in_si_as_its_remedy():
    texts = {
        "1 mm": "0.001 (m)",
        "2.5e3 N": "2500 (N)",
        "70GPa": "70000000000 (Pa)",
        "12": "12",
        "12 apples": "",
        "initial": "",
    }
    assert {text: in_si(text) for text in texts} == texts
    assert in_si(None) == in_si(3.0) == ""
    with refused("duration", "1 ms", "Try: 0.001 (s)"):
        mbd.simulate(mbd.examples.pendulum(), "1 ms")  # pyright: ignore[reportArgumentType]
    with refused("limit", "1 mm", "Try: 0.001 (m)"):
        _ = mbd.Max(mbd.StrainEnergy("arm")) <= "1 mm"


def test_a_unit_that_cannot_be_is_refused():
    assert "deg, rad" in (misfit("rod.laminate.angles", "mm") or "")
    assert "MPa" in (misfit("rod.laminate.ply.E1", "deg") or "")
    assert misfit("rod.laminate.thickness", "in") is None
    assert misfit("rod.laminate.thickness", "none") is None
    assert misfit("motor.size", "mm") is None
    assert misfit("law.anything", "mm") is None
    assert misfit("release.load.offset", "N") is None  # of a measured channel of any quantity
    for wrong in ("mm", "kg", "deg", "ms"):
        assert "N/mm" in (misfit("spring.stiffness", wrong) or "")
    assert misfit("spring.stiffness", "N/mm") is None
    assert misfit("hinge.stiffness", "N m") is None
    assert misfit("tip.mass", "Hz") is not None


def test_units_of_changes_of_temperature():
    """A change of 9 degF is one of 5 K; coefficients of expansion and gradients have their own units."""
    assert 9.0 * factor("degF") == pytest.approx(5.0 * factor("K"), rel=1e-15)
    assert factor("degC") == factor("K") == 1.0
    assert misfit("panel.laminate.ply.alpha2", "ppm/K") is None
    assert misfit("cooling.temperature", "degC") is None
    assert "K, degC, degF" in (misfit("cooling.temperature", "K/m") or "")
    assert "1/K, ppm/K" in (misfit("rod.section.alpha", "deg") or "")
    assert misfit("cooling.gradient", "K/mm") is None
