"""Sections of bars: numbers of PBAR and PBEAM, stations, neutral axes away from the center of shear."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from tests.refused import warned
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.cards import parse_cards
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.materials import UNITS
from torchmbd.extensions.nastran.sections import section_of
from torchmbd.extensions.nastran.shapes import of_shape

E, G = 100.0, 40.0


def section(text: str, units: str = "m"):
    lines = [(f"line {k}", line) for k, line in enumerate(["MAT1,2,100.,40.,.25,10.", *text.splitlines()], start=1)]
    data = BulkData.of(parse_cards(lines))
    (card,) = data.properties.values()
    return section_of(data, card, UNITS[units])


def test_products_of_inertia():
    """Curvatures about y and z bend an L about both: the determinant is that of the principal axes."""
    K = section("PBAR,5,2,2.,8.,4.,.1,,\n,\n,.5,.25,3.").stiffness()
    expected = torch.tensor([[4.0, -3.0], [-3.0, 8.0]], dtype=torch.float64)
    assert_close(K[4:, 4:], E * expected)
    assert_close(K.diagonal()[:4], torch.tensor([E * 2, G * 1.0, G * 0.5, G * 0.1], dtype=torch.float64))


def test_the_neutral_axis_of_a_beam():
    """N1, N2: an axial force on the line of the centers of shear bends; shear does not twist."""
    K = section("PBEAM,5,2,2.,8.,4.,0.,.1\n,\n,1.,1.\n,,,,,.3,-.2").stiffness()
    # eps at the neutral axis: eps + N2 kappa_y - N1 kappa_z
    g = torch.tensor([1.0, 0, 0, 0, -0.2, -0.3], dtype=torch.float64)
    expected = E * 2.0 * torch.outer(g, g)
    expected += torch.diag(torch.tensor([0, G * 2, G * 2, G * 0.1, E * 4, E * 8], dtype=torch.float64))
    assert_close(K, expected)


@pytest.mark.parametrize("blank", ["", ",\n"])
def test_a_tapered_beam_is_its_mean(blank):
    """A from 2 to 1, 4 in the middle where given; C to F may stand as a blank line after NO."""
    with warned("PBEAM 5", "A 1.5"):
        K = section(f"PBEAM,5,2,2.,8.,4.,0.,.1\n,\n,NO,1.,1.,4.,2.,0.,.1\n{blank},.5,.5").stiffness()
    numbers = [E * 1.5, G * 0.75, G * 0.75, G * 0.1, E * 3, E * 6]
    assert_close(K, torch.diag(torch.tensor(numbers, dtype=torch.float64)))
    with warned("changes along"):
        K = section(
            "PBEAM,5,2,2.,8.,4.,0.,.1\n,\n,YES,.5,4.,8.,4.,0.,.1\n,\n,YES,1.,2.,8.,4.,0.,.1\n,\n,.5,.5"
        ).stiffness()
    assert float(K[0, 0]) == pytest.approx(3.0 * E)


def test_named_beams():
    """A T2 in inches; a PBEAML of the same measures has its line at the center of shear."""
    own = of_shape("T2", [10.0, 4.0, 1.0, 1.0])
    bar, inch = section("PBARL,5,2,,T2\n,10.,4.,1.,1.", "in"), 0.0254
    force = 4.4482216152605
    assert float(bar.stiffness()[0, 0]) == pytest.approx(E * own.A * force)
    assert float(bar.stiffness()[5, 5]) == pytest.approx(E * own.I1 * force * inch**2)
    beam = section("PBEAML,5,2,,T2\n,10.,4.,1.,1.,,YES,1.,10.\n,4.,1.,1.").stiffness()
    assert float(beam[0, 5]) == pytest.approx(-E * own.A * own.center[0])
    with warned("PBEAML 5"):
        tapered = section("PBEAML,5,2,,BAR\n,1.,2.,0.,YES,.5,1.,2.,0.\n,YES,1.,1.,4.,0.")
    assert float(tapered.stiffness()[0, 0]) == pytest.approx(E * 2.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("PBARL,5,2,,BOX\n,1.,1.,.6,.1", ["PBARL 5 (line 2)", "BOX", "0.6", "walls"]),
        ("PBARL,5,2,,L\n,1.,1.,.1,.1", ["TYPE = 'L'", "CHAN2"]),
        ("PBEAML,5,2,,HAT\n,1.,1.,.1,.1", ["TYPE = 'HAT'"]),
        ("PBEAM,5,2,2.,8.,4.,9.,.1", ["PBEAM 5", "positive definite"]),
        ("PBEAM,5,2,2.,,4.,9.,.1", ["PBEAM 5", "I1 = ''"]),
    ],
)
def test_what_is_wrong_is_named(text, words):
    with pytest.raises(InputError) as error:
        section(text)
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    ("card", "words"),
    [
        ("PBAR,5,2,0.,8.,4.,.1", "PBAR 5 (line 2): A = 0"),
        ("PBAR,5,2,-1.,8.,4.,.1,3.", "PBAR 5 (line 2): A = -1"),
        ("PBEAM,5,2,0.,8.,4.,0.,.1", "PBEAM 5 (line 2): A = 0"),
    ],
)
def test_a_section_without_area_is_refused(card, words):
    with pytest.raises(InputError) as error:
        section(card)
    assert words in str(error.value)
