"""Nastran's coordinate systems, rigid elements and supports, read from text."""

import math

import numpy as np
import pytest

from tests.refused import ANY, refused, warned
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.cards import parse_cards
from torchmbd.extensions.nastran.data import BulkData


def data(text: str) -> BulkData:
    return BulkData.of(parse_cards([(f"line {k}", line) for k, line in enumerate(text.splitlines(), start=1)]))


def test_grids_in_rectangular_and_cylindrical_systems_that_refer_to_each_other():
    """System 2 (cylindrical, its z along basic x) stands in system 1 (shifted), and is given before it."""
    text = (
        "CORD2C,2,1,0.,0.,0.,1.,0.,0.\n,0.,1.,0.\nCORD2R,1,0,10.,0.,0.,10.,0.,1.\n,11.,0.,0.\n"
        "GRID,7,2,3.,90.,4.\nGRID,8,1,1.,2.,3.\nGRID,9,,1.,2.,3."
    )
    result = data(text)
    assert result.grids[8] == pytest.approx((11.0, 2.0, 3.0))
    assert result.grids[9] == (1.0, 2.0, 3.0)
    # z of system 2 is basic x, its x is basic y, so its y is basic z: at 90 degrees the radius points along basic z.
    assert result.grids[7] == pytest.approx((14.0, 0.0, 3.0))


def test_a_system_by_grids():
    text = "GRID,1,,1.,1.,0.\nGRID,2,,1.,1.,5.\nGRID,3,,1.,4.,0.\nCORD1R,6,1,2,3\nGRID,4,6,2.,0.,0."
    result = data(text)
    assert result.grids[4] == pytest.approx((1.0, 3.0, 0.0))
    card = result.grid_cards[4]
    assert result.systems.axes(6, card, np.zeros(3))[0].tolist() == pytest.approx([0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("CORD2R,1,1,0.,0.,0.,0.,0.,1.\n,1.,0.,0.\nGRID,5,1,1.,1.,1.", ["CORD2R 1", "refers to itself"]),
        ("CORD2R,1,0,0.,0.,0.,0.,0.,1.\n,0.,0.,3.\nGRID,5,1,1.,1.,1.", ["CORD2R 1", "on a line"]),
        ("CORD1R,6,1,2,3\nGRID,4,6,2.,0.,0.", ["CORD1R 6", "GRID 1 does not exist"]),
    ],
)
def test_broken_systems(text, words):
    with pytest.raises(InputError) as error:
        data(text)
    assert all(word in str(error.value) for word in words), str(error.value)


GRIDS = "\n".join(f"GRID,{k},,{k}.,0.,0." for k in range(1, 10))


def test_rigid_elements():
    """RBE2 with a range; RBE3 with two weights, its end marked by UM."""
    result = data(f"{GRIDS}\nRBE2,30,1,123456,2,THRU,5\nRBE3,31,,9,123456,1.5,123,6,7\n,2.,123,8,UM,1,1")
    two, three = result.rigids
    assert (two.grid, two.others, two.weights) == (1, (2, 3, 4, 5), ())
    assert (three.grid, three.others, three.weights) == (9, (6, 7, 8), (1.5, 1.5, 2.0))


def test_supports_of_both_kinds():
    result = data(f"{GRIDS}\nSPC1,4,123,1,THRU,3\nSPC,5,7,12345,0.,8,3")
    assert [(s.set, s.components, s.grids) for s in result.supports] == [
        (4, "123", (1, 2, 3)), (5, "12345", (7,)), (5, "3", (8,)),
    ]  # fmt: skip
    assert data(f"{GRIDS}\nSPC,5,7,1,.3").ignored == {"enforced displacement of SPC": 1}


def test_masses_and_properties():
    result = data(f"{GRIDS}\nCONM2,1,3,0,2.5\n,3.,,6.,,,9.\nPARAM,WTMASS,.00259\nMAT1,1,7.+10,,.3,2700.")
    (mass,) = result.masses
    assert (mass.grid, mass.mass, mass.rotary) == (3, 2.5, 6.0)
    assert result.weight_to_mass == 0.00259
    with refused("MAT8 1 (line 12).ID", ANY, "MAT1 1 (line 11)"):
        data(f"{GRIDS}\nPARAM,POST,0\nMAT1,1,7.+10,,.3,2700.\nMAT8,1,1.,1.,.3,1.")


def test_thickness_at_corners_is_refused():
    with refused("CQUAD4 1 (line 10).T", ANY, ".2"):
        data(f"{GRIDS}\nCQUAD4,1,1,1,2,3,4\n,,,.2")
    assert math.isclose(data(f"{GRIDS}\nPSHELL,1,1,.1\nCTRIA3,1,1,1,2,3,30.").shells[0].theta, 30.0)


def test_a_grid_may_hold_itself():
    """Permanent constraints are supports of set 0."""
    result = data("GRID,1,,0.,0.,0.,,123456\nGRID,2,,1.,0.,0.,,6")
    assert [(s.set, s.components, s.grids) for s in result.supports] == [(0, "123456", (1,)), (0, "6", (2,))]


def test_x_of_a_cylindrical_system_is_the_radius_at_the_place():
    """Axis along z through (1, 1, 0); at (1, 4, 7) the radius points along y, at (-1, -1, 0) to both sides."""
    result = data("CORD2C,2,0,1.,1.,0.,1.,1.,1.\n,2.,1.,0.\nGRID,1,,1.,4.,7.")
    axes = result.systems.axes(2, result.grid_cards[1], np.array([1.0, 4.0, 7.0]))
    assert axes.tolist() == [pytest.approx(row) for row in ([0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0])]
    aslant = result.systems.axes(2, result.grid_cards[1], np.array([-1.0, -1.0, 0.0]))[0]
    assert aslant.tolist() == pytest.approx([-math.sqrt(0.5), -math.sqrt(0.5), 0.0])
    with refused("GRID 1 (line 3).CID", ANY, "system 2"):
        result.systems.axes(2, result.grid_cards[1], np.array([1.0, 1.0, 3.0]))


@pytest.mark.parametrize("card", ["CPYRAM,1,2,3,4,5,6,7", "BAROR,,5,,,0.,1.,0.", "BEAMOR,,5", "RJOINT,5,1,2,123"])
def test_cards_that_change_others_are_refused(card):
    with pytest.raises(InputError, match="cannot be read, and without it the structure may be another"):
        data(f"GRID,1,,0.,0.,0.\n{card}")


def test_inertias_that_differ_are_named():
    with warned("CONM2 9", "[1.0, 2.0, 3.0]", "their mean, 2,"):
        (mass,) = data("GRID,1,,0.,0.,0.\nCONM2,9,1,,5.\n,1.,,2.,,,3.").masses
    assert mass.rotary == pytest.approx(2.0)
    with warned("CONM2 9", "[0.5, 0.0, 0.0]", "their mean, 2,"):
        data("GRID,1,,0.,0.,0.\nCONM2,9,1,,5.\n,2.,.5,2.,,,2.")
    with refused("CONM2 9 (line 2).CID", "-1"):
        data("GRID,1,,1.,0.,0.\nCONM2,9,1,-1,5.,0.,0.,0.")
