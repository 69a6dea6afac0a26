"""Given sections, sections off the line, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.sections.section_cases import ANBA, general_section
from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.fem.elements.beam_section import BeamSection, GivenSection, line_transform
from torchmbd.fem.sections import Section, SectionMesh


def test_both_kinds_keep_the_contract():
    result = general_section()
    given = GivenSection(result.stiffness().detach(), result.mass())
    assert isinstance(result, BeamSection)
    assert isinstance(given, BeamSection)
    assert_close(given.stiffness().detach(), result.stiffness().detach(), rtol=1e-9, atol=1e-6)
    assert not given.matrix.requires_grad


def test_isotropic_rectangle():
    b, h, E, nu = 0.02, 0.03, 210e9, 0.3
    result = GivenSection.isotropic(E, nu, 7850.0, b * h, b * h**3 / 12, h * b**3 / 12, 1.5e-8)
    G = E / 2.6
    expected = [E * b * h, 5 / 6 * G * b * h, 5 / 6 * G * b * h, G * 1.5e-8, E * b * h**3 / 12, E * h * b**3 / 12]
    assert result.stiffness().diagonal().tolist() == pytest.approx(expected)
    assert result.mass()[3, 3] == pytest.approx(float(result.mass()[4, 4] + result.mass()[5, 5]))


def test_a_section_off_the_line_is_the_section_with_moved_nodes():
    """Offset and twist by W against the analysis of the moved and turned section."""
    made, offset, twist = general_section(), (0.02, -0.035), 0.6
    c, s = math.cos(twist), math.sin(twist)
    R = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    nodes = made.mesh.nodes @ R.T + torch.tensor(offset, dtype=torch.float64)
    moved = Section(SectionMesh(nodes, made.mesh.elements, made.mesh.layer), ANBA, made.angles.detach())
    W = line_transform(torch.tensor(offset, dtype=torch.float64), torch.tensor(twist, dtype=torch.float64))
    for here, there in ((made.stiffness(), moved.stiffness()), (made.mass(), moved.mass())):
        result, exact = (W @ here @ W.T).detach(), there.detach()
        d = exact.diagonal().rsqrt()
        assert float(((result - exact) * d[:, None] * d).abs().max()) < 1e-9


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda K: K[:3, :3], ["shape (3, 3)", "6 x 6"]),
        (lambda K: K * math.nan, ["finite"]),
        (lambda K: K - torch.diag(torch.tensor([0, 0, 10.0, 0, 0, 0])), ["entry 3,3 = -7.0"]),
        (lambda K: K + 0.1 * torch.triu(torch.ones(6, 6), 1), ["entries", "equal"]),
        (lambda K: torch.full((6, 6), 2.0), ["must be positive definite"]),
        (lambda K: "steel", ["'steel'", "6 x 6"]),
    ],
)
def test_bad_matrices_are_named(change, words):
    K = torch.diag(torch.arange(1.0, 7.0, dtype=torch.float64))
    with pytest.raises(InputError) as error:
        GivenSection(change(K), K)
    for word in ["stiffness of a section", *words]:
        assert word in str(error.value)


def test_bad_numbers_are_named():
    with refused("J", 0.0):
        GivenSection.isotropic(1.0, 0.3, 1.0, 1.0, 1.0, 1.0, 0.0)
    with pytest.raises(InputError) as error:
        GivenSection.isotropic(1.0, 0.6, 1.0, 1.0, 1.0, 1.0, 1.0)
    assert (error.value.path, error.value.value) == (("nu",), 0.6)
    zero = torch.zeros(1, dtype=torch.float64)
    with refused("offset"):
        line_transform(torch.full((1, 2), math.nan), zero)
    with pytest.raises(InputError) as error:
        line_transform(torch.zeros(1, 2), zero + 90.0)
    assert (error.value.path, error.value.value) == (("twist",), [90.0])


def test_designs_of_matrices():
    """The symmetric part counts; one that is not definite is named."""
    K = torch.diag(torch.tensor([2e5, 1e5, 1e5, 20.0, 30.0, 40.0], dtype=torch.float64))
    section = mbd.GivenSection(K, torch.eye(6, dtype=torch.float64) * torch.tensor([1.0, 1, 1, 2, 1, 1]))
    column = mbd.FlexibleBody.beam("column", mbd.BeamLine.straight(1.0, 4), section, modes=2, reference="start")
    system = mbd.System([column], [mbd.Fixed(mbd.Ground().at(), column.at("start"))])
    upper = K.clone()
    upper[3, 4] = 10.0
    both = 0.5 * (upper + upper.T)
    bent, lower, symmetric = (
        mbd.equilibrium(system, designs={"column.section.matrix": x[None]}).vibrations[0].frequencies
        for x in (upper, upper.T, both)
    )
    assert_close(bent, symmetric)
    assert_close(lower, symmetric)
    wrong = torch.stack([K, K.clone()])
    wrong[1, 4, 4] = -1.0
    with refused("stiffness"):
        mbd.simulate(system, 0.1, steps=2, designs={"column.section.matrix": wrong})
