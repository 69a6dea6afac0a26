"""Sections along a beam: tables, BeamDyn's files, one for each element, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import PLANE, coupled, given, matrix
from tests.fem.exact_beam.cosserat import cantilever
from tests.refused import ANY, refused


def test_a_table_is_linear_between_its_stations():
    thick, thin = given(4.0, 2.0, 2.0, 2.0, 2.0, 2.0), given(2.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    table = mbd.SectionTable([0.0, 0.4, 1.0], [thick, thick, thin])
    at = torch.tensor([[0.0, 0.2], [0.4, 0.7], [0.9, 1.0]], dtype=torch.float64)
    result = table.stiffness(at)
    assert result.shape == (3, 2, 6, 6)
    assert result[..., 0, 0].flatten().tolist() == pytest.approx([4.0, 4.0, 4.0, 3.0, 2.0 + 1.0 / 3.0, 2.0])
    assert table.mass(at).shape == (3, 2, 6, 6)
    assert [name for name, _ in table.named_parameters()] == ["0.matrix", "2.matrix"]


RAGGED = [0.0, 0.13, 0.1301, 0.19, 0.1901, 0.3, 0.62, 0.83, 1.0]  # a ballast of 0.18 m, a taper, a kink
MASSES = [10.0, 10.0, 1010.0, 1010.0, 10.0, 20.0, 5.0, 5.0, 1.0]  # [kg/m]
SOFTNESS = [1.0, 1.0, 50.0, 50.0, 1.0, 1.0, 3.0, 2.0, 2.0]
SPAN = 3.0  # [m]


def ragged() -> mbd.SectionTable:
    stiffness = matrix(1e8, 1e7, 1e7, 1e5, 1e6, 1e6)
    mass = matrix(1.0, 1.0, 1.0, 0.02, 0.01, 0.01)
    return mbd.SectionTable(RAGGED, [(stiffness / c, m * mass) for m, c in zip(MASSES, SOFTNESS, strict=True)])


def over_the_table(values, power: int = 0) -> float:
    """Integral of s^power times a function that is linear between the stations, by itself."""
    s = np.linspace(0.0, 1.0, 2_000_001)
    return float(np.trapezoid(np.interp(s, RAGGED, values) * (SPAN * s) ** power, SPAN * s))


@pytest.mark.parametrize("elements", [1, 2, 3, 5, 8, 13, 50])
def test_mass_does_not_depend_on_the_number_of_elements(elements):
    """Mass, first and second moment about the root, of the statics and of a motion."""
    line = mbd.BeamLine.straight(SPAN, elements)
    beam = mbd.ExactBeam("beam", line, ragged())
    weight = beam.equilibrium(gravity=(0.0, 0.0, -1.0)).reactions[0, 2].item()
    assert weight == pytest.approx(over_the_table(MASSES), rel=1e-6)  # of the sum beside it
    mass, first, second = mbd.FlexibleBeam("beam", line, ragged()).structure()[:3]
    x = line.nodes[:, 0]
    moments = (
        mass.sum(),
        (mass * x + first[:, 0]).sum(),
        (mass * x**2 + 2.0 * first[:, 0] * x + second[:, 0, 0]).sum(),
    )
    for power, moment in enumerate(moments):
        assert moment.item() == pytest.approx(over_the_table(MASSES, power), rel=1e-6)


@pytest.mark.parametrize("elements", [1, 2, 3, 5, 8, 13, 50])
def test_compliance_does_not_depend_on_the_number_of_elements(elements):
    """Stretch under a force, turn under a moment: integrals of 1 / stiffness, which is linear between the stations."""
    beam = mbd.ExactBeam("beam", mbd.BeamLine.straight(SPAN, elements), ragged())
    s = np.linspace(0.0, 1.0, 2_000_001)
    softness = 1.0 / np.interp(s, RAGGED, [1.0 / c for c in SOFTNESS])
    integral = float(np.trapezoid(softness, SPAN * s))
    stretch = beam.equilibrium({"end": (1.0, 0.0, 0.0)}).nodes[-1, 0].item() - SPAN
    assert stretch == pytest.approx(integral / 1e8, rel=1e-4)
    turned = beam.equilibrium({"end": (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}).rotations[-1, 1, 0].item()
    assert turned == pytest.approx(integral / 1e6, rel=1e-4)


@pytest.mark.parametrize("elements", [1, 2, 4, 8])
@pytest.mark.parametrize("place", [0.03, 0.11, 0.3, 0.5, 0.77])
def test_a_soft_spot_bends_where_it_lies(elements, place):
    """Deflection and turn of the tip under forces there: integrals of moments by compliances, wherever nodes are."""
    bending, shear, twist, length = np.array([1e6, 4e5]), np.array([1e7, 2e7]), 0.4, 2.0
    spots, soft = [place - 0.012, place - 0.0115, place + 0.0115, place + 0.012], 0.01
    at, factors = [0.0, *spots, 1.0], [1.0, 1.0, soft, soft, 1.0, 1.0]
    sections = [(matrix(1e8, *shear, 1e5, *bending) * c, PLANE) for c in factors]
    line = mbd.BeamLine.straight(length, elements)
    beam = mbd.ExactBeam("beam", line, mbd.SectionTable(at, sections), twist=twist)
    force = np.array([0.3, -0.7])  # along y and z
    state = beam.equilibrium({"end": (0.0, *force)})
    s = np.linspace(0.0, 1.0, 2_000_001)
    softness = 1.0 / np.interp(s, at, factors)
    total, moment, second = (float(np.trapezoid(softness * (length * (1.0 - s)) ** k, length * s)) for k in range(3))
    turned = np.array([[np.cos(twist), -np.sin(twist)], [np.sin(twist), np.cos(twist)]])
    across = np.array([[0.0, 1.0], [-1.0, 0.0]])  # an arm times a force along y or z turns the beam about z or -y
    by_moment = across @ turned @ np.diag(1.0 / bending) @ turned.T @ across.T
    by_force = turned @ np.diag(1.0 / shear) @ turned.T
    tip = (second * by_moment + total * by_force) @ force
    assert state.nodes[-1, 1:].numpy() == pytest.approx(tip, rel=1e-4)
    slope = moment * by_moment @ force  # of the displacements along y and z
    assert state.rotations[-1, 1:, 0].numpy() == pytest.approx(slope, rel=1e-4)


@pytest.mark.thorough
def test_a_tapered_twisted_coupled_beam_is_that_of_the_differential_equation():
    K = coupled()
    table = mbd.SectionTable([0.0, 1.0], [(K, PLANE), (0.5 * K, PLANE)])
    n = 24
    twist = torch.linspace(0.0, 0.8, n + 1, dtype=torch.float64)
    beam = mbd.ExactBeam("blade", mbd.BeamLine.straight(1.0, n), table, twist=torch.stack([twist[:-1], twist[1:]], 1))
    force, moment, load = np.array([0.4, 1.2, -0.8]), np.array([0.3, 0.1, -0.2]), np.array([0.0, 0.5, 1.0])
    state = beam.equilibrium({"end": (*force, *moment)}, line_load=load.tolist())
    expected = cantilever(1.0, lambda s: (1.0 - 0.5 * s) * K.numpy(), np.array([0.8, 0.0, 0.0]), force, moment, load)
    assert state.status == "ok"
    assert np.abs(state.nodes[-1].numpy() - expected).max() < 2e-3 * np.linalg.norm(expected - [1.0, 0.0, 0.0])


def test_one_section_for_each_element():
    thick, thin = given(1e5, 1e5, 1e5, 2.0, 4.0, 4.0), given(1e5, 1e5, 1e5, 1.0, 1.0, 1.0)
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 40), [thick] * 20 + [thin] * 20)
    assert [name for name, _ in beam.named_parameters()] == ["section0.matrix", "section1.matrix"]
    state = beam.equilibrium({"end": (0.0, 0.0, 1e-6)})
    expected = 1e-6 * ((1.0 - 0.125) / 3.0 / 4.0 + 0.125 / 3.0 + 1.0 / 1e5)
    assert state.nodes[-1, 2].item() == pytest.approx(expected, rel=1e-3)


def test_a_section_that_is_not_positive_definite_is_refused_with_its_position():
    bad = matrix(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    bad[4, 5] = bad[5, 4] = 2.0
    with refused("sections.0.3.stiffness", ANY, "positive definite"):
        mbd.SectionTable([0.0, 0.3, 1.0], [(PLANE, PLANE), (bad, PLANE), (PLANE, PLANE)])
    table = mbd.SectionTable([0.0, 0.5, 1.0], [given(*[1.0] * 6) for _ in range(3)])
    beam = mbd.ExactBeam("blade", mbd.BeamLine.straight(2.0, 4), table)
    with torch.no_grad():
        table.sections[1].matrix[3, 3] = -1.0
    with refused("blade.section"):
        beam.equilibrium({"end": (0.0, 0.1, 0.0)})


@pytest.mark.parametrize(
    ("positions", "sections", "path"),
    [
        ([0.0, 0.5], 2, "positions"),
        ([0.0, 0.7, 0.6, 1.0], 4, "positions"),
        ([0.0, 1.0], 3, "sections"),
    ],
)
def test_tables_that_are_refused(positions, sections, path):
    with refused(path):
        mbd.SectionTable(positions, [given(*[1.0] * 6)] * sections)


def test_more_that_is_refused():
    with refused("sections.1", "thin"):
        mbd.SectionTable([0.0, 1.0], [given(*[1.0] * 6), "thin"])
    line = mbd.BeamLine([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 0, 0]], [[0, 1], [1, 2], [1, 3]])
    table = mbd.SectionTable([0.0, 1.0], [given(*[1.0] * 6)] * 2)
    with refused("fork.section"):
        mbd.ExactBeam("fork", line, table)
    with refused("fork.section"):
        mbd.ExactBeam("fork", line, [given(*[1.0] * 6)] * 2)
    with refused("ring.line", ANY, "2.6 rad"):
        mbd.ExactBeam("ring", mbd.BeamLine.arc(1.0, 3.0, 1), given(*[1.0] * 6))
