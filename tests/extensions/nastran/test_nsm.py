"""Mass without stiffness that a case control chooses; mass of models against a sum over their cards."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused, warned
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.body import bulk_body

#: Grid k at (k, 0), grid 100 + k at (k, 2): shell k has area 2, a side line k has length 1.
GRIDS = [f"GRID,{k + row},,{k}.,{2 * (row > 0)}.,0." for row in (0, 100) for k in range(1, 9)]
#: Shells, bars, rods and panels with their own mass: 3 kg/m2, 5 kg/m, 2.5 kg/m, 0 and 1 kg/m2.
MODEL = [
    *("CQUAD4,1,1,1,2,102,101", "CTRIA3,2,2,2,3,102", "CTRIA3,12,2,3,103,102", "CBAR,3,3,1,2,0.,0.,1."),
    *("CBEAM,4,4,2,3,0.,0.,1.", "CROD,5,5,3,4", "CONROD,6,4,5,9,1.-3", "CSHEAR,7,7,4,5,105,104", "CTUBE,8,8,5,6"),
    *(
        "PSHELL,1,9,.001,9,,,,1.",
        "PCOMP,2\n,9,.001,0.,YES",
        "PBAR,3,9,2.-3,1.-6,1.-6,1.-6,1.",
        "PBEAM,4,9,2.-3,1.-6,1.-6,,1.-6",
    ),
    *("PROD,5,9,1.-3,,,.5", "PSHEAR,7,9,.0005", "PTUBE,8,9,.1,.01", "MAT1,9,7.+10,,.3,2000."),
]
AREA = {1: 2.0, 2: 1.0, 12: 1.0, 7: 2.0}
LENGTH = {3: 1.0, 4: 1.0, 5: 1.0, 6: 1.0, 8: 1.0}
OWN = (
    3.0 * 2.0 + 2.0 * 2.0 + 5.0 + 4.0 + 2.5 + 2.0 + 1.0 * 2.0
    + 2000.0 * 3.14159265358979 / 4.0 * (0.1**2 - 0.08**2)
)  # fmt: skip
PROPERTY = {"PSHELL": {1: [1]}, "PCOMP": {2: [2, 12]}, "PBAR": {3: [3]}, "PBEAM": {4: [4]}, "PROD": {5: [5]}}
PROPERTY |= {"PSHEAR": {7: [7]}, "PTUBE": {8: [8]}, "CONROD": {6: [6]}}


@pytest.fixture
def mass(tmp_path):
    """Mass of a deck of the model and cards, whose case control has these lines; None: bulk data alone."""

    def read(*cards: str, control: tuple[str, ...] | None = ("NSM = 5",), model=(*GRIDS, *MODEL)) -> float:
        above = [] if control is None else ["SOL 103", "CEND", *control, "BEGIN BULK"]
        path = tmp_path / "model.bdf"
        path.write_text("\n".join([*above, *model, *cards, "ENDDATA"]))
        return sum(float(part.masses().mass.sum()) for part in bulk_body(path).parts.values())

    return read


def test_the_model_itself(mass):
    assert mass() == pytest.approx(OWN, rel=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("cards", "extra"),
    [
        (["NSM,5,PSHELL,1,3."], 6.0),
        (["NSM,5,PSHELL,1,3.", "NSM,5,PBAR,3,4."], 10.0),
        (["NSM,5,ELEMENT,2,3.,12,1.,7,.5\n,3,2."], 3.0 + 1.0 + 1.0 + 2.0),
        (["NSM1,5,PCOMP,3.,ALL"], 6.0),
        (["NSM1,5,ELEMENT,3.,3,THRU,6"], 12.0),
        (["NSM1,5,ELEMENT,3.,4,THRU,8,BY,2"], 9.0),
        (["NSM1,5,CONROD,3.,6", "NSM1,5,PTUBE,2.,8"], 5.0),
        (["NSML,5,PSHELL,1,3.,,,"], 3.0),
        (["NSML,5,ELEMENT,1,3.,2,4."], 7.0),
        (["NSML1,5,ELEMENT,3.,1,2,12"], 3.0),
        (["NSML1,5,PSHEAR,3.,ALL"], 3.0),
        (["NSMADD,5,6,7", "NSM,6,PROD,5,1.", "NSML1,7,PBEAM,4.,4"], 5.0),
        (["NSM,6,PROD,5,1."], 0.0),
    ],
    ids=lambda given: str(given)[:60],
)
def test_cards_of_mass(cards, extra, mass):
    """Each card adds the mass that the manual says, at once for its own unit of mass."""
    if extra == 0.0:
        with refused("model.bdf.NSM", "5"):
            mass(*cards)
        return
    assert mass(*cards) == pytest.approx(OWN + extra, rel=1e-12)
    assert mass(*cards, "PARAM,WTMASS,.5") == pytest.approx(0.5 * (OWN + extra), rel=1e-12)
    assert mass(*cards, control=("PARAM,WTMASS,.5", "NSM=5")) == pytest.approx(0.5 * (OWN + extra), rel=1e-12)


@pytest.mark.thorough
def test_what_the_case_control_chooses(mass):
    """Not chosen: left out, with a word; no case control: the only set is taken, with a word; several sets: refused."""
    with warned("NSM", "(1)", "case control"):
        assert mass("NSM,5,PSHELL,1,3.", control=()) == pytest.approx(OWN)
    with warned("set 5 of NSM"):
        assert mass("NSM,5,PSHELL,1,3.", control=None) == pytest.approx(OWN + 6.0)
    with refused("model.bdf.NSM", "5, 6"):
        mass("NSM,5,PSHELL,1,3.", "NSM,6,PSHELL,1,3.", control=None)
    with refused("model.bdf.NSM", "5, 6"):
        mass("NSM,5,PSHELL,1,3.", "NSM,6,PSHELL,1,3.", control=("SUBCASE 1", "NSM = 5", "SUBCASE 2", "NSM = 6"))


@pytest.mark.parametrize(
    ("card", "words"),
    [
        ("NSM,5,PSHELL,2,3.", ["NSM 5", "PSHELL", "[2]"]),
        ("NSM1,5,ELEMENT,3.,99", ["[99]"]),
        ("NSM,5,PSHELL,1,-3.", ["-3"]),
        ("NSML1,5,ELEMENT,3.,1,3", ["areas and lengths"]),
        ("NSMADD,5,6", ["NSMADD 5", "[6]"]),
        ("NSM,5,PSHELL,1", ["VALUE"]),
    ],
)
def test_what_is_refused(card, words, mass):
    with pytest.raises(InputError) as error:
        mass(card, "NSM,7,PSHELL,1,1.")
    assert all(word in str(error.value) for word in [*words, "model.bdf, line"]), str(error.value)


@pytest.mark.thorough
def test_mass_lies_where_the_laminate_lies(tmp_path):
    """NSM of a card and that of a PSHELL give the same mass matrix of rigid motions, also with an offset and in millimeters."""
    above = "SOL 103\nCEND\nNSM = 5\nBEGIN BULK\nGRID,1,,0.,0.,0.\nGRID,2,,900.,0.,0.\nGRID,3,,900.,500.,0.\n"
    above += "GRID,4,,0.,500.,0.\nCQUAD4,1,1,1,2,3,4,,40.\nMAT1,9,70.+3,,.3,2.-9\n"
    path, result = tmp_path / "model.bdf", []
    for cards in ("PSHELL,1,9,2.,9,,,,3.-9", "PSHELL,1,9,2.,9\nNSM,5,PSHELL,1,3.-9"):
        path.write_text(above + cards)
        body = mbd.io.read_bdf(path, "b", modes=2, units="mm")
        M, _ = body.mass_and_stiffness()
        x = body.mesh.nodes.detach().numpy()
        rigid = np.zeros((len(x), 6, 6))
        rigid[:, range(6), range(6)] = 1.0
        rigid[:, 0, 4], rigid[:, 0, 5], rigid[:, 1, 5] = x[:, 2], -x[:, 1], x[:, 0]
        rigid[:, 1, 3], rigid[:, 2, 3], rigid[:, 2, 4] = -x[:, 2], x[:, 1], -x[:, 0]
        result.append(rigid.reshape(-1, 6).T @ M @ rigid.reshape(-1, 6))
    # That of the PSHELL has rotary inertia of its thickness.
    assert result[0] == pytest.approx(result[1], rel=1e-4, abs=1e-9)
    assert result[0][0, 0] == pytest.approx(7e-9 * 900 * 500 * 1e3, rel=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_mass_of_any_deck_is_the_sum_of_its_cards(seed, mass):
    """A random choice of cards, each with the mass that it adds, some of them written by replication."""
    draw = random.Random(seed)
    cards, total, numbers = [], OWN, itertools.count(1000)
    for _ in range(draw.randint(1, 6)):
        value = round(draw.uniform(0.1, 9.0), 3)
        kind = draw.randrange(6)
        sizes = AREA if draw.random() < 0.5 else LENGTH
        elements = draw.sample(sorted(sizes), draw.randint(1, len(sizes)))
        size = sum(sizes[k] for k in elements)
        words = ",".join(map(str, elements))
        if kind == 0:
            cards, total = [*cards, f"NSM1,5,ELEMENT,{value},{words}"], total + value * size
        elif kind == 1:
            cards, total = [*cards, f"NSML1,5,ELEMENT,{value},{words}"], total + value
        elif kind == 2:
            pairs = ",".join(f"{k},{value}" for k in elements[:3])
            cards, total = [*cards, f"NSML,5,ELEMENT,{pairs}"], total + value * len(elements[:3])
        elif kind == 3:
            name, members = draw.choice(sorted(PROPERTY.items()))
            ((number, own),) = members.items()
            area = sum((AREA | LENGTH)[k] for k in own)
            cards, total = [*cards, f"NSM,5,{name},{number},{value}"], total + value * area
        elif kind == 4:
            cards, total = [*cards, f"CONM2,{next(numbers)},{draw.randint(1, 6)},,{value}"], total + value
        else:
            first = next(numbers)
            cards += [f"CONM2,{first},1,,{value}", "=,*(100),*1,==", f"=({draw.choice([1, 3])})"]
            total += value * (2 + int(cards[-1][2]))
    cards += ["NSM,5,PSHELL,1,0."]
    assert mass(*cards) == pytest.approx(total, rel=1e-12), cards


def test_the_part_is_one_of_points(tmp_path):
    path = tmp_path / "model.bdf"
    path.write_text("\n".join(["CEND", "NSM = 5", "BEGIN BULK", *GRIDS, *MODEL, "NSM,5,PBAR,3,4."]))
    points = bulk_body(path).parts["nsm"].masses()
    assert torch.equal(points.mass, torch.tensor([2.0, 2.0], dtype=torch.float64))
