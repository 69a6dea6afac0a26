"""Failure criteria: a published example, the uniaxial limits, derivatives against differences, forms of few coordinates."""

import math

import pytest
import torch
from torch.testing import assert_close

from torchmbd.errors import InputError
from torchmbd.fem.materials import CRITERIA, FailureForms, Ply, Strength, tsai_wu, tsai_wu_irf
from torchmbd.fem.materials.laminate import strain_rotations

GRAPHITE_EPOXY = Strength(Xt=1500e6, Xc=1500e6, Yt=40e6, Yc=246e6, S12=68e6)
GENERAL = Strength(Xt=1500e6, Xc=1200e6, Yt=40e6, Yc=246e6, S12=68e6, S13=60e6, S23=35e6, interaction=-0.3)


def tensor(*x):
    return torch.tensor(x, dtype=torch.float64)


def test_kaw_60_degree_lamina():
    """sig = (2, -3, 4) S on a 60 degree ply: S = 16.33 MPa by maximum stress, 22.39 MPa by Tsai-Wu.

    A. K. Kaw, Mechanics of Composite Materials, 2nd ed., examples 2.13 and 2.19 (graphite/epoxy, table 2.1).
    """
    T, _ = strain_rotations(tensor(math.pi / 3)[0])
    own = torch.linalg.solve(T.mT, tensor(2.0, -3.0, 4.0)[:, None])[:, 0]  # stresses turn by the inverse transpose
    stress = torch.cat([own, tensor(0.0, 0.0)])
    strength = GRAPHITE_EPOXY.numbers()
    assert 1e-6 / float(CRITERIA["max_stress"](stress, strength)) == pytest.approx(16.33, abs=0.01)
    assert 1e-6 / float(tsai_wu_irf(stress, strength)) == pytest.approx(22.39, abs=0.01)
    assert float(tsai_wu(22.39e6 * stress, strength)) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize(
    ("component", "limit"),
    [(0, 1500e6), (0, -1200e6), (1, 40e6), (1, -246e6), (2, 68e6), (2, -68e6), (3, 60e6), (3, -60e6), (4, -35e6)],
)
def test_every_criterion_is_one_at_every_uniaxial_strength(criterion, component, limit):
    stress = torch.zeros(5, dtype=torch.float64)
    stress[component] = limit
    expected = 0.0 if criterion == "interlaminar" and component < 3 else 1.0  # it looks at shear between layers alone
    assert float(CRITERIA[criterion](stress, GENERAL.numbers())) == pytest.approx(expected, rel=1e-12)


def test_the_inverse_reserve_factor_scales_with_the_load():
    stress = 1e7 * tensor(30.0, -2.0, 1.5, 0.4, -0.7)
    strength = GENERAL.numbers()
    irf = tsai_wu_irf(stress, strength)
    assert_close(tsai_wu_irf(2.5 * stress, strength), 2.5 * irf)
    assert_close(tsai_wu(stress / irf, strength), tensor(1.0)[0])
    assert float(tsai_wu_irf(0.0 * stress, strength)) == 0.0


@pytest.mark.thorough
@pytest.mark.parametrize("criterion", CRITERIA)
def test_derivative_by_the_stress(criterion):
    generator = torch.Generator().manual_seed(3)
    stress = 5e7 * torch.randn(20, 5, generator=generator, dtype=torch.float64)
    strength = GENERAL.numbers()

    def function(x):
        return CRITERIA[criterion](1e7 * x, strength)

    assert torch.autograd.gradcheck(function, (stress / 1e7).requires_grad_(), eps=1e-6, atol=1e-8)
    assert torch.autograd.gradcheck(
        function, (stress / 1e7).requires_grad_(), eps=1e-6, atol=1e-8, check_forward_ad=True
    )
    rest = torch.zeros(1, 5, dtype=torch.float64, requires_grad=True)
    assert torch.isfinite(torch.autograd.grad(function(rest).sum(), rest)[0]).all()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"Xt": 0.0}, ["Xt", "0.0", "> 0"]),
        ({"Yc": -5.0}, ["Yc", "-5.0", "> 0"]),
        ({"S12": math.nan}, ["S12", "nan"]),
        ({"S23": True}, ["S23", "True"]),
        ({"interaction": 1.0}, ["interaction", "1.0"]),
    ],
)
def test_bad_strengths_are_named(given, words):
    with pytest.raises(InputError) as error:
        Strength(**({"Xt": 1.0, "Xc": 1.0, "Yt": 1.0, "Yc": 1.0, "S12": 1.0} | given))
    assert all(word in str(error.value) for word in words)


def test_a_ply_takes_a_strength_only():
    with pytest.raises(InputError) as error:
        Ply.isotropic(1.0, 0.3, 1.0, strength=3.0)
    assert (error.value.path, error.value.value) == (("strength",), 3.0)


STRENGTHS = torch.stack(
    [
        Strength(1500e6, 1200e6, 50e6, 250e6, 70e6).numbers(),
        Strength(900e6, 700e6, 40e6, 180e6, 60e6, 55e6, 30e6, interaction=-0.2).numbers(),
    ]
)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_forms_are_the_indices_of_the_stresses(criterion):
    make = torch.Generator().manual_seed(5)
    basis = 1e8 * torch.randn(7, 5, 3, generator=make, dtype=torch.float64)
    strength = STRENGTHS[torch.tensor([0, 1, 1, 0, 0, 1, 0])]
    w = torch.randn(11, 3, generator=make, dtype=torch.float64)
    w[4] = 0.0
    stress = torch.einsum("pck,nk->npc", basis, w)
    assert_close(FailureForms(criterion, basis, strength)(w), CRITERIA[criterion](stress, strength))
