"""The hybrid wing-body of pyNastran's repository: read unedited, mass as printed. Needs PYNASTRAN_MODELS, its folder models."""

from __future__ import annotations

import pytest

from experiments.peers import wing_body

pytestmark = pytest.mark.skipif(
    wing_body.deck() is None, reason=f"{wing_body.VARIABLE} names no folder models of SteveDoyle2/pyNastran"
)


@pytest.fixture(scope="module")
def wing() -> wing_body.Wing:
    path = wing_body.deck()
    assert path is not None
    return wing_body.read(path)


def test_it_is_read_unedited(wing):
    """One message lists what was left out; every stack has its angles."""
    assert len(wing.body.mesh.quads) == 9236
    assert sum("cards that do not describe structure are left out" in text for text in wing.messages) == 1
    assert len(wing.laminates) == 62
    assert all(len(laminate.angles) == 10 for laminate in wing.laminates.values())


def test_mass_and_center_are_the_printed_ones(wing):
    """Within the area of warped cells, which count in full here."""
    mass, center, inertia = wing_body.mass_properties(wing)
    assert mass == pytest.approx(wing_body.PRINTED_MASS, rel=2e-4)
    assert center.tolist() == pytest.approx(wing_body.PRINTED_CENTER, rel=2e-3)
    assert inertia.tolist() == pytest.approx(wing_body.PRINTED_INERTIA, rel=3e-3)


@pytest.mark.slow
def test_frequencies_are_those_of_another_program(wing):
    """The aft body hangs on drilling freedoms, which MYSTRAN leaves soft; upper panels within 6 %, all others within 2 %."""
    result = wing_body.frequencies(wing)
    for (name, other), ours in zip(wing_body.MYSTRAN, result, strict=True):
        if "drilling" not in name:
            assert ours == pytest.approx(other, rel=0.06 if name == "upper panels" else 0.02), name
