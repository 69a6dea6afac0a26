"""Transverse shear from equilibrium: against closed forms, published factors, and by its own laws."""

import pytest
import torch
from torch.func import functional_call, jacfwd, jacrev, vmap
from torch.testing import assert_close

from tests.refused import refused
from torchmbd.fem.materials import IsotropicMean, Laminate, Ply
from torchmbd.fem.materials.transverse_shear import inverse2
from torchmbd.math.angles import deg

PAGANO = Ply(E1=25.0, E2=1.0, G12=0.5, G13=0.5, G23=0.2, nu12=0.25, density=1.0)
CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.0e9, G23=3.9e9, nu12=0.23, density=1586.0)
FOAM = Ply(E1=80e6, E2=60e6, G12=25e6, G13=30e6, G23=20e6, nu12=0.3, density=60.0)


def general(**given):
    """Unbalanced, unsymmetric, soft in the middle: nothing vanishes."""
    plies = [CARBON, FOAM, CARBON, CARBON]
    return Laminate(
        plies, deg([20, 35, -50, 75]), [1e-3, 8e-3, 1.5e-3, 0.5e-3], **({"shear_correction": "energy"} | given)
    )


def test_an_isotropic_plate_has_five_sixths_however_it_is_cut():
    ply = Ply.isotropic(70e9, 0.3, 2700.0)
    As = Laminate(ply, deg([0, 40, -70]), [1e-3, 2.5e-3, 0.5e-3], shear_correction="energy").stiffness().As
    expected = 5 / 6 * 70e9 / 2.6 * 4e-3 * torch.eye(2, dtype=torch.float64)
    assert_close(As, expected, rtol=1e-12, atol=1e-6)


@pytest.mark.parametrize(("angles", "kx", "ky"), [([0, 90], 0.59518, 0.72053), ([90, 0], 0.72053, 0.59518)])
def test_whitney_cross_ply(angles, kx, ky):
    """Factors of 0/90/90/0 (E1/E2 = 25), by cylindrical bending: J. M. Whitney, J. Appl. Mech. 40 (1973) 302-304.

    Ours let Poisson's ratio act across the direction of bending: a difference of 4e-4.
    """
    laminate = Laminate(PAGANO, deg(angles), 0.25, symmetric=True, shear_correction="energy")
    full = Laminate(PAGANO, deg(angles), 0.25, symmetric=True, shear_correction=1.0).stiffness().As
    factors = laminate.stiffness().As.diagonal() / full.diagonal()
    assert factors.tolist() == pytest.approx([kx, ky], rel=5e-4)


def sandwich_stiffness(E, Ec, G, Gc, face, core):
    """As of a symmetric isotropic sandwich (equal Poisson's ratios), by Jourawski's formula done by hand."""
    c, H = core / 2, core / 2 + face
    D = 2 / 3 * (Ec * c**3 + E * (H**3 - c**3))
    # First moment S(z) of E from the face: E (H^2 - z^2) / 2 outside, S(c) + Ec (c^2 - z^2) / 2 inside.
    outside = E**2 / 4 * (H**4 * (H - c) - 2 / 3 * H**2 * (H**3 - c**3) + (H**5 - c**5) / 5)
    s = E * (H**2 - c**2) / 2
    inside = s**2 * c + s * Ec * (c**3 - c**3 / 3) + Ec**2 / 4 * (c**5 - 2 / 3 * c**5 + c**5 / 5)
    return D**2 / (2 * (outside / G + inside / Gc))


@pytest.mark.parametrize("softness", [1.0, 10.0, 1000.0, 100000.0])
def test_sandwich_against_the_closed_form(softness):
    """Faces 1 mm, core 20 mm; 5/6 of the sum is right at softness 1 and hundreds of times too stiff at the end."""
    skin, core = Ply.isotropic(70e9, 0.3, 2700.0), Ply.isotropic(70e9 / softness, 0.3, 50.0)
    laminate = Laminate([skin, core, skin], [0.0, 0.0, 0.0], [1e-3, 20e-3, 1e-3], shear_correction="energy")
    G = 70e9 / 2.6
    expected = sandwich_stiffness(70e9, 70e9 / softness, G, G / softness, 1e-3, 20e-3)
    assert laminate.stiffness().As.diagonal().tolist() == pytest.approx([expected, expected], rel=1e-10)
    if softness > 1e4:  # thin stiff faces: Gc d^2 / core, d the distance of the faces' middles
        assert expected == pytest.approx(G / softness * 21e-3**2 / 20e-3, rel=5e-3)


def test_the_shape_is_in_equilibrium():
    """F is zero at both faces, continuous between the layers, and its integral is the unit matrix."""
    laminate = general()
    shape = laminate.shear_shape()
    bottom, top = shape.at(0.0).detach(), shape.at(1.0).detach()
    scale = float(shape.at(0.5).detach().abs().max())
    assert_close(bottom[0], torch.zeros(2, 2, dtype=torch.float64), rtol=0, atol=0)
    assert_close(top[-1], torch.zeros(2, 2, dtype=torch.float64), rtol=0, atol=1e-12 * scale)
    assert_close(bottom[1:], top[:-1], rtol=1e-12, atol=1e-12 * scale)
    simpson = (bottom + 4 * shape.at(0.5).detach() + top) / 6  # exact for the parabolas
    total = (laminate.thickness[:, None, None] * simpson).sum(0)
    assert_close(total.detach(), torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-12)


def test_one_ply_turns_and_correction_only_softens():
    """A quarter turn swaps the axes (cylindrical bending along x and y is no invariant between them)."""
    lone, quarter = (Laminate(CARBON, deg(a), 4e-3, shear_correction="energy").stiffness().As for a in ([0], [90]))
    assert_close(quarter, lone.flip(0, 1), rtol=1e-12, atol=1e-3)
    As, full = general().stiffness().As, general(shear_correction=1.0).stiffness().As
    assert_close(As, As.mT, rtol=1e-12, atol=1e-9 * float(As.detach().max()))
    assert float(torch.linalg.eigvalsh(full - As).min()) > 0
    assert float(torch.linalg.eigvalsh(As).min()) > 0


def test_derivatives_by_angles_and_thicknesses_in_lanes():
    laminate = general()
    names = ("angles", "thickness")

    def function(*x):
        return functional_call(laminate, dict(zip(names, x, strict=True)))

    one = tuple(getattr(laminate, name).detach() for name in names)
    two = tuple(x.flip(0) + 0.01 * x for x in one)
    lanes = tuple(torch.stack(pair) for pair in zip(one, two, strict=True))
    batched = vmap(jacfwd(function, argnums=(0, 1)))(*lanes)
    for lane, x in enumerate((one, two)):
        for k in range(2):
            forward, reverse = jacfwd(function, argnums=k)(*x), jacrev(function, argnums=k)(*x)
            scale = float(reverse.abs().max())
            assert_close(forward, reverse, rtol=1e-9, atol=1e-12 * scale)
            assert_close(batched[k][lane], forward, rtol=1e-9, atol=1e-12 * scale)
            step = 1e-6 if k == 0 else 1e-9
            for i in range(len(x[k])):
                up, down = (x[k] + sign * step * torch.eye(len(x[k]), dtype=torch.float64)[i] for sign in (1, -1))
                ends = [function(*(moved if j == k else x[j] for j in range(2))) for moved in (up, down)]
                difference = (ends[0] - ends[1]) / (2 * step)
                assert_close(forward[:, i], difference, rtol=1e-5, atol=1e-6 * float(difference.abs().max()))
    assert_close(function(*lanes)[1], function(*two), rtol=1e-13, atol=0)


def test_the_mean_of_the_element_does_not_follow_the_angles():
    """The shear length is the same for all angles, and that of the sandwich, not of the sum of its plies."""
    lengths = [
        IsotropicMean.of(
            Laminate([CARBON, FOAM, CARBON], deg(a), [1e-3, 9e-3, 1e-3], shear_correction="energy")
        ).shear_length
        for a in ([0, 0, 0], [70, 20, -35])
    ]
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-12)
    naive = IsotropicMean.of(
        Laminate([CARBON, FOAM, CARBON], deg([0, 0, 0]), [1e-3, 9e-3, 1e-3], False, 5 / 6)
    ).shear_length
    assert lengths[0] > 3 * naive


def test_small_inverses():
    X = torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert_close(inverse2(X[:, :2, :2]), torch.linalg.inv(X[:, :2, :2]))


@pytest.mark.parametrize("value", ["enrgy", 0.0, 1.2, True])
def test_a_wrong_correction_is_named(value):
    with refused("shear_correction"):
        general(shear_correction=value)
