"""Coefficients of thermal expansion of material cards."""

from __future__ import annotations

import pytest
import torch

from tests.extensions.nastran.test_sections import section
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.cards import parse_cards
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.materials import UNITS, ply_of
from torchmbd.extensions.nastran.sections import section_of
from torchmbd.extensions.nastran.shells import laminate_of


@pytest.mark.parametrize(
    ("card", "expected"),
    [
        ("MAT1,2,100.,40.,.25,10.,12.-6", (12e-6, 12e-6)),
        ("MAT1,2,100.,40.,.25,10.", (None, None)),
        ("MAT8,2,128.,10.,.23,5.,5.,5.,1586.,\n,-.3-6,28.-6,20.", (-0.3e-6, 28e-6)),
        ("MAT8,2,128.,10.,.23,5.,5.,5.,1586.,\n,,28.-6", (0.0, 28e-6)),  # a blank beside a number is zero
        ("MAT8,2,128.,10.,.23,5.,5.,5.,1586.", (None, None)),
    ],
)
def test_plies(card, expected):
    """They are per degree of the file, whatever its units of length."""
    (parsed,) = parse_cards([(f"line {k}", line) for k, line in enumerate(card.splitlines(), start=1)])
    ply = ply_of(parsed, UNITS["mm"])
    assert (ply.alpha1, ply.alpha2) == expected


def with_metal(lines: str) -> tuple[BulkData, Card]:
    """A file of one property of a metal that expands."""
    cards = ["MAT1,2,1.+11,,.25,10.,12.-6", *lines.splitlines()]
    data = BulkData.of(parse_cards([(f"line {k}", card) for k, card in enumerate(cards, start=1)]))
    (card,) = data.properties.values()
    return data, card


def test_a_beam_whose_neutral_axis_is_off_its_line():
    """It expands alike at every point, so it stays straight; without A a temperature is refused."""
    beam = "PBEAM,5,2,2.,8.,4.,.5,.1\n,,,,,,,,\n" + 2 * ",,,,,,,,\n" + ",,,,,.3,.7,.3,.7"
    strain = section_of(*with_metal(beam), UNITS["m"]).free_strain("temperature")
    torch.testing.assert_close(strain, 12e-6 * torch.eye(6, dtype=torch.float64)[0])
    with pytest.raises(InputError, match="alpha"):
        section("PBAR,5,2,2.,8.,4.,.1").free_strain("temperature")


@pytest.mark.parametrize(("shell", "has"), [("PSHELL,7,2,1.,2", True), ("PSHELL,7,2,1.", False)])
def test_shells(shell, has):
    """A shell whose bending is not that of its material has no coefficients, so a temperature is refused by name."""
    laminate = laminate_of(*with_metal(shell), UNITS["m"])
    if has:
        strain = laminate.expansion(temperature=2.0).strain
        torch.testing.assert_close(
            strain, torch.tensor([24e-6, 24e-6, 0.0], dtype=torch.float64), rtol=1e-9, atol=1e-18
        )
    else:
        with pytest.raises(InputError, match="alpha1"):
            laminate.expansion(temperature=2.0)
