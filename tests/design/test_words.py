"""Responses in words: titles and units of whatever Python or a file makes of them."""

from __future__ import annotations

from functools import partial

import pytest

import torchmbd as mbd
from tests.refused import refused
from torchmbd.design.words import heading, unit, words

X, Y = mbd.Position("rod", "x", node="right"), mbd.Position("rod", "y", node="right")


def tip_deviation(motion, factor=1.0):
    return motion.q[..., 0] * factor


@pytest.mark.parametrize(
    ("response", "said"),
    [
        (mbd.Integral(mbd.StrainEnergy("rod")), "integral of strain energy of rod [J s]"),
        (mbd.Max(abs(X - 0.3)), "max of |x position of rod - 0.3| [m]"),
        (mbd.Max(X**2 + Y**2), "max of squared x position of rod + squared y position of rod [m²]"),
        (mbd.Max(mbd.history(tip_deviation)), "max of tip deviation"),
        (mbd.Max(mbd.history(partial(tip_deviation, factor=2.0))), "max of tip deviation"),
        (-mbd.Frequency("rod"), "-frequency of rod [Hz]"),
        (mbd.Mass("a") + mbd.Mass("b"), "mass of a + mass of b [kg]"),
        (mbd.Mass("a") - mbd.Mass("b"), "mass of a - mass of b [kg]"),
        (mbd.Mass("a") * mbd.Mass("b"), "mass of a · mass of b [kg²]"),
        (1e3 * mbd.Mass(), "1000 · mass of all bodies"),
        (mbd.WeightedSum([(1.0, mbd.Mass("a"))]), "weighted sum"),
        (mbd.RMS(mbd.Reaction("hinge", "z", kind="torque")), "rms of z reaction torque of hinge [N m]"),
    ],
)
def test_titles(response, said):
    assert heading(response) == said


@pytest.mark.extensions
def test_a_measure_without_a_name_in_files_has_that_of_its_class():
    damage = mbd.fatigue.Damage(mbd.Reaction("hinge", "z"), curve=mbd.fatigue.SNCurve([(1e3, 4e8), (1e6, 2e8)]))
    assert heading(damage) == "damage of z reaction of hinge"
    assert unit(damage) == ""


def test_without_bodies():
    assert words(mbd.Max(X), bodies=False) == "max of x position"
    assert unit(mbd.Max(X * Y)) == "m²"


def test_a_function_may_have_a_unit():
    @mbd.history(unit="N")
    def pin_force(motion):
        return motion.reaction("pin").force.norm(dim=-1)

    assert heading(mbd.Max(pin_force)) == "max of pin force [N]"
    assert unit(mbd.Integral(pin_force)) == "N s"
    assert unit(mbd.measure(lambda motion: motion.t)) is None
    with refused("unit", 3):
        mbd.measure(unit=3)(lambda motion: motion.t)


def test_the_mass_of_no_body_in_particular_is_that_of_all():
    assert words(mbd.Mass()) == "mass of all bodies"
    assert words(mbd.Mass("rod")) == "mass of rod"
