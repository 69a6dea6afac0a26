"""A change of temperature as a load: closed forms of plates and beams, residual stresses, frequencies, gradients, bad input."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.refused import ANY, refused, warned
from torchmbd.diagnosis.truncation import StaticTruncation, warn_static_truncation
from torchmbd.results.ply_history import changes_of

GROUND = mbd.Ground()
CARBON = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6, beta1=0.0, beta2=0.4)
STEEL = mbd.Ply.isotropic(210e9, 0.0, 7850.0, alpha=12e-6)
BRASS = mbd.Ply.isotropic(100e9, 0.0, 8500.0, alpha=19e-6)
E, ALPHA, SIDE = 210e9, 12e-6, (0.02, 0.005)
AREA, I_Y = SIDE[0] * SIDE[1], SIDE[0] * SIDE[1] ** 3 / 12.0
kinds = pytest.mark.parametrize("kind", ["triangle", "quad"])


def held(body: mbd.FlexibleBody, *forces: mbd.Temperature, **options: Any) -> mbd.System:
    """The body held at its only reference node, where its frame is."""
    (node,) = body.reference
    x, y, z = (float(k) for k in body.origin)
    body.position.copy_(tensor(x, y, z))
    return mbd.System([body], [mbd.Fixed(GROUND.at(x, y, z), body.at(node))], list(forces), truncation=None, **options)


def skewed(laminate: mbd.Laminate, kind: str, **options: Any) -> mbd.FlexibleBody:
    """A plate of distorted cells, held at one node."""
    flat = mbd.mesh.rectangle(0.3, 0.2, (4, 3), kind=kind)
    x, y, z = flat.nodes.T
    nodes = torch.stack([x + 0.1 * y + 0.4 * x * y, y + 0.3 * x * y, z], 1)
    cells: dict = {"triangles": flat.triangles} if kind == "triangle" else {"quads": flat.quads}
    mesh = mbd.mesh.Mesh(nodes, **cells)
    return mbd.FlexibleBody.plate("panel", mesh, laminate, 2, reference=5, **({"expansion": True} | options))


def displacements(body: mbd.FlexibleBody, *forces: mbd.Temperature) -> Tensor:
    """Displacements and rotations of all nodes [n, 6] in the state of equilibrium."""
    w = mbd.equilibrium(held(body, *forces)).body(body.name).w[0, 0]
    return (body.structure()["psi"] @ w).detach()


def strip(laminate: mbd.Laminate, **options: Any) -> mbd.FlexibleBody:
    mesh = mbd.mesh.rectangle(0.2, 0.02, (8, 2))
    return mbd.FlexibleBody.plate("strip", mesh, laminate, 2, reference="left", expansion=True, **options)


def bar(section: Any = None, elements: int = 4, **options: Any) -> mbd.FlexibleBody:
    metal = section or mbd.GivenSection.isotropic(E, 0.3, 7850.0, AREA, I_Y, 16.0 * I_Y, 3.0 * I_Y, alpha=ALPHA)
    arguments: dict = {"modes": 2, "reference": "start", "expansion": True} | options
    return mbd.FlexibleBody.beam("bar", mbd.BeamLine.straight(0.5, elements), metal, **arguments)


@kinds
def test_every_node_of_a_free_plate_moves_by_classical_lamination(kind):
    """An unbalanced stack on distorted cells: u = eps x, w and rotations by the curvatures, exact for any mesh."""
    laminate = mbd.Laminate(CARBON, mbd.deg([20, -50, 75]), [0.3e-3, 0.2e-3, 0.4e-3])
    body = skewed(laminate, kind)
    moved = displacements(body, mbd.Temperature(body, -30.0, gradient=2e3, moisture=0.002))
    free = laminate.expansion(-30.0, 2e3, 0.002)
    x, y, _ = (body.mesh.nodes - body.origin).T
    (ex, ey, exy), (kx, ky, kxy) = free.strain.detach(), free.curvature.detach()
    slope = torch.stack([-(kx * x + 0.5 * kxy * y), -(0.5 * kxy * x + ky * y)])  # of w, which is zero at the origin
    w = -0.5 * (kx * x**2 + kxy * x * y + ky * y**2)
    in_plane = torch.stack([ex * x + 0.5 * exy * y, 0.5 * exy * x + ey * y, 0.0 * x], 1)
    across = torch.stack([w, slope[1], -slope[0]], 1)
    assert_close(moved[:, [0, 1, 5]], in_plane, rtol=0, atol=1e-6 * float(in_plane.abs().max()))
    assert_close(moved[:, 2:5], across, rtol=0, atol=1e-6 * float(across.abs().max()))
    assert float(in_plane.abs().max()) > 1e-7


@kinds
def test_a_quasi_isotropic_plate_expands_alike(kind):
    laminate = mbd.Laminate(CARBON, mbd.deg([0, 60, -60]), 0.2e-3, symmetric=True)
    body = skewed(laminate, kind)
    d = 1 - 0.23**2 * 10.1 / 128
    Q11, Q22, Q12 = 128 / d, 10.1 / d, 0.23 * 10.1 / d
    alpha = (Q11 * -0.3e-6 + Q12 * (28e-6 - 0.3e-6) + Q22 * 28e-6) / (Q11 + Q22 + 2 * Q12)
    moved = displacements(body, mbd.Temperature(body, 80.0))
    assert_close(moved[:, :3], 80.0 * alpha * (body.mesh.nodes - body.origin), rtol=0, atol=1e-6 * 80.0 * alpha * 0.3)


def test_bimetal_of_timoshenko():
    """Deflection of the tip of a strip of two metals, kappa L^2 / 2 (Timoshenko 1925, eq. 4), by equilibrium and slowly."""
    lower, upper, change, L = 0.8e-3, 1.3e-3, 75.0, 0.2
    body = strip(mbd.Laminate([BRASS, STEEL], [0.0, 0.0], [lower, upper]), damping=0.01)
    h, m, n = lower + upper, lower / upper, 100.0 / 210.0
    curvature = (
        6 * (12e-6 - 19e-6) * change * (1 + m) ** 2 / (h * (3 * (1 + m) ** 2 + (1 + m * n) * (m**2 + 1 / (m * n))))
    )
    moved = displacements(body, mbd.Temperature(body, change))[body.mesh.node("right"), 2]
    assert float(moved) == pytest.approx(-curvature * L**2 / 2, rel=1e-6)
    body.damped(0.5)
    ramp = held(body, mbd.Temperature(body, lambda t: change * (t / 0.5).clamp(max=1.0)))
    motion = mbd.simulate(ramp, 1.0, steps=60, backend="eager").require_ok()
    end = motion.body("strip").at("right").position[0, -1, 2].detach()
    assert float(end) == pytest.approx(-curvature * L**2 / 2, rel=1e-4)
    energies = motion.energies
    assert float(energies.balance.detach().abs().max()) < 1e-2 * float(energies.applied.detach().abs().max())


def test_residual_stresses_of_a_cross_ply():
    """[0/90]s, free and cooled: the closed form of equal strains whose forces cancel; and none while it is held."""
    change = -150.0
    strong = mbd.Ply(
        128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, mbd.examples.carbon().strength, 0.0, -0.3e-6, 28e-6
    )
    body = skewed(mbd.Laminate(strong, mbd.deg([0, 90]), 0.25e-3, symmetric=True), "quad")
    d = 1 - 0.23**2 * 10.1 / 128
    Q11, Q22, Q12 = 128e9 / d, 10.1e9 / d, 0.23 * 10.1e9 / d
    e = change * (Q11 * -0.3e-6 + Q12 * 27.7e-6 + Q22 * 28e-6) / (Q11 + Q22 + 2 * Q12)
    along = Q11 * (e + 0.3e-6 * change) + Q12 * (e - 28e-6 * change)
    across = Q12 * (e + 0.3e-6 * change) + Q22 * (e - 28e-6 * change)
    plies = mbd.PlyHistory(mbd.equilibrium(held(body, mbd.Temperature(body, mbd.variable(change)))), "panel")
    expected = tensor(along, across, 0.0, 0.0, 0.0).expand(1, 1, len(plies.points), 5)
    assert_close(plies.stress().detach(), expected, rtol=0, atol=1e-6 * across)
    strength = strong.strength
    assert strength is not None
    index = plies.failure("max_stress")
    assert float(index) == pytest.approx(max(across / strength.Yt, -along / strength.Xc), rel=1e-6)


@pytest.mark.thorough
def test_a_zone_that_becomes_warmer_pulls_the_other():
    """Two halves of a strip side by side: the section of Timoshenko's beam of two parts, heated in one of them."""
    L, b = 0.2, 0.01
    mesh = mbd.mesh.rectangle(L, 2 * b, (16, 4))
    upper = mesh.nodes[mesh.quads].mean(1)[:, 1] > 0.0
    plates = {
        name: mbd.fem.elements.Plates(mesh, mbd.Laminate(STEEL, [0.0], 1e-3), cells=torch.nonzero(x)[:, 0])
        for name, x in (("upper", upper), ("lower", ~upper))
    }
    body = mbd.FlexibleBody("panel", mesh, plates, 2, reference="left", expansion=["upper", "lower"])
    assert len(body.expansion.loads) == 4
    moved = displacements(body, mbd.Temperature(body, 50.0, zone="upper"))
    curvature = 1.5 * 12e-6 * 50.0 / (2 * b)  # of a step of the free strain over the depth 2 b: 3 / 2 strain / depth
    nodes = [int((mesh.nodes - tensor(x, 0.0, 0.0)).norm(dim=1).argmin()) for x in (-0.05, 0.0, 0.05)]
    before, middle, behind = moved[nodes]
    assert abs(float(before[1] - 2.0 * middle[1] + behind[1])) == pytest.approx(curvature * 0.05**2, rel=1e-2)
    assert float(behind[0] - before[0]) == pytest.approx(0.5 * 12e-6 * 50.0 * 0.1, rel=1e-2)
    both = displacements(body, mbd.Temperature(body, 50.0, zone="upper"), mbd.Temperature(body, 50.0, zone="lower"))
    assert_close(both[:, :3], 12e-6 * 50.0 * (mesh.nodes - body.origin), rtol=0, atol=1e-10)
    with refused("panel.zone", "uper", meant="upper"):
        mbd.Temperature(body, 50.0, zone="uper")


def test_a_bar_between_walls_is_pressed():
    """N = -E A alpha T, of metal by its numbers and of plies; and no stress where it is free."""
    plies = mbd.sections.rectangle(*SIDE, mbd.Ply.isotropic(E, 0.3, 7850.0, alpha=ALPHA), cells=(2, 2))
    for section in (None, plies):
        body = bar(section)
        walls = [mbd.Fixed(GROUND.at(x, 0, 0), body.at(end)) for x, end in ((0.0, "start"), (0.5, "end"))]
        result = mbd.equilibrium(mbd.System([body], walls, [mbd.Temperature(body, 0.05)]))
        beams = mbd.SectionHistory(result, "bar")
        forces = beams.forces()[0, 0].detach()
        assert_close(forces[:, 0], tensor(-E * AREA * ALPHA * 0.05).expand(8), rtol=1e-6, atol=0)
        if section is not None:
            assert_close(beams.stress()[0, 0, ..., 0].detach().mean(), tensor(-E * ALPHA * 0.05)[0], rtol=1e-6, atol=0)
        free = mbd.SectionHistory(mbd.equilibrium(held(body, mbd.Temperature(body, 0.05, 0.03, -0.02))), "bar")
        assert float(free.forces().detach().abs().max()) < 1e-6 * E * AREA * ALPHA * 0.05


def test_gradients_of_temperature_bend_a_beam():
    """The curvature is alpha times the gradient, so each leg of an L is an arc. The line lies off its nodes, and is twisted."""
    body = mbd.FlexibleBody.beam(
        "bar",
        mbd.BeamLine.straight(0.5, 2),
        mbd.GivenSection.isotropic(E, 0.3, 7850.0, AREA, I_Y, 16.0 * I_Y, 3.0 * I_Y, alpha=ALPHA),
        1,
        reference="start",
        twist=0.3,
        offset=(0.01, -0.02),
        expansion=True,
    )
    moved = displacements(body, mbd.Temperature(body, 40.0, gradient=30.0, gradient_y=-20.0))[-1]
    c, s = math.cos(0.3), math.sin(0.3)
    by_y, by_z = -20.0 * c - 30.0 * s, -20.0 * s + 30.0 * c  # along the axes of the beam
    middle = ALPHA * (40.0 - 0.01 * by_y + 0.02 * by_z)  # at the line, off the axis of the section
    expected = tensor(0.5 * middle, -ALPHA * by_y * 0.125, -ALPHA * by_z * 0.125)
    assert_close(moved[:3], expected, rtol=1e-6, atol=1e-15)


def test_sections_of_plies_expand_as_laminates():
    """A thin strip of [0/90]: curvature and strain of classical lamination; its residual stresses carry no force."""
    section = mbd.sections.strip(0.02, CARBON, mbd.deg([0, 90]), thickness=0.125e-3)
    free, plate = section.expansion("temperature"), mbd.Laminate(CARBON, mbd.deg([0, 90]), 0.125e-3).expansion(1.0)
    assert float(free.strain[0]) == pytest.approx(float(plate.strain[0]), rel=2e-3)
    assert float(free.strain[4]) == pytest.approx(float(plate.curvature[0]), rel=2e-3)
    assert_close(section.free_strain("temperature"), free.strain, rtol=1e-9, atol=1e-15)
    solid = mbd.sections.rectangle(*SIDE, mbd.Ply.isotropic(70e9, 0.3, 2700.0, alpha=23e-6), cells=(2, 2))
    for change, place, sign in (("temperature", 0, 1.0), ("gradient", 4, 1.0), ("gradient_y", 5, -1.0)):
        result = solid.expansion(change)
        expected = sign * 23e-6 * torch.nn.functional.one_hot(torch.tensor(place), 6).double()
        assert_close(result.strain.detach(), expected, rtol=1e-9, atol=1e-14)
        assert float(result.stress.detach().abs().max()) < 1e-9 * 70e9 * 23e-6


@pytest.mark.parametrize("angles", [[40.0], [40.0, 40.0]])
def test_sections_of_one_slanted_ply_shear(angles):
    """All strains are uniform and free of stress: eps = a1 c^2 + a2 s^2, gamma_xy = 2 (a1 - a2) s c."""
    section = mbd.sections.strip(0.04, CARBON, mbd.deg(angles), thickness=1e-3)
    free = section.expansion("temperature")
    c, s = math.cos(math.radians(40.0)), math.sin(math.radians(40.0))
    a1, a2 = -0.3e-6, 28e-6
    expected = tensor(a1 * c**2 + a2 * s**2, 2.0 * (a1 - a2) * s * c, 0.0, 0.0, 0.0, 0.0)
    assert_close(free.strain.detach(), expected, rtol=0, atol=1e-12)
    assert_close(section.free_strain("temperature"), free.strain, rtol=0, atol=0)
    assert float(free.stress.detach().abs().max()) < 1e-9 * 128e9 * a2


def test_sections_of_an_unbalanced_stack_shear_as_plates():
    """[10, 60]s of a thin strip: the strain and the shear of classical lamination, but for its edges."""
    section = mbd.sections.strip(0.04, CARBON, mbd.deg([10, 60, 60, 10]), thickness=0.125e-3)
    plate = mbd.Laminate(CARBON, mbd.deg([10, 60]), 0.125e-3, symmetric=True).expansion(1.0).strain.detach()
    free = section.free_strain("temperature").detach()
    assert_close(free[:2], plate[[0, 2]], rtol=1e-2, atol=0)
    assert float(free[2:].abs().max()) < 1e-9


@pytest.mark.parametrize("angles", [[30, 60], [10, 60], [20, -50, 75], [10, 60, -25]])
def test_shear_of_an_unsymmetric_strip_is_that_on_which_a_force_works(angles):
    """Classical lamination has other numbers: gamma = gamma_xy + 2 c / a kappa_y + b / (2 a) kappa_xy.

    A bending moment in the plane, strain eps_x = y kappa_z, causes N_x = a eps_x, M_x = b eps_x, M_xy = c eps_x in the plies.
    A force V_y has this moment x V_y, so M_xy' = Q and M_y = 2 c / a (3 / 2 V_y / w) (1 - 4 y^2 / w^2), which works on the
    curvature kappa_y of the free strip; M_x works on the warping that comes with kappa_xy. [30, 60]: 9 % of gamma_xy.
    """
    laminate = mbd.Laminate(CARBON, mbd.deg(angles), 0.25e-3)
    (_, _, gamma), (_, bent, twisted) = (x.detach() for x in laminate.expansion(1.0)[2:4])
    A, B, D = (x.detach() for x in laminate.stiffness()[:3])
    matrix = torch.cat([torch.cat([A, B], 1), torch.cat([B, D], 1)])
    strain, free = torch.eye(6, dtype=torch.float64)[0], [1, 2, 4]  # without N_y, N_xy, M_y; kappa_x = kappa_xy = 0
    strain[free] = -torch.linalg.solve(matrix[free][:, free], matrix[free, 0])
    a, b, c = (matrix @ strain)[[0, 3, 5]]
    expected = gamma + 2.0 * c / a * bent + 0.5 * b / a * twisted
    strips = [mbd.sections.strip(w, CARBON, mbd.deg(angles), thickness=0.25e-3) for w in (0.04, 0.08)]
    narrow, wide = (section.free_strain("temperature").detach()[1] for section in strips)
    assert abs(float(expected - gamma)) > 0.05 * abs(float(gamma))
    assert float(2.0 * wide - narrow) == pytest.approx(float(expected), rel=1e-3)  # edges fall with the width


@pytest.mark.thorough
def test_a_warm_beam_between_walls_vibrates_more_slowly():
    """f^2 of a beam on two hinges is (1 - P / P_E) times that without load, of P = E A alpha T and Euler's load P_E."""
    euler = math.pi**2 * E * I_Y / 0.5**2

    def square(share: float) -> float:
        body = bar(elements=8, modes=4, stiffening=True)
        hinges = [mbd.Revolute(GROUND.at(x, 0, 0), body.at(end), "y") for x, end in ((0.0, "start"), (0.5, "end"))]
        heat = mbd.Temperature(body, share * euler / (E * AREA * ALPHA))
        system = mbd.System([body], hinges, [heat], truncation=None)
        return float(mbd.equilibrium(system).vibrations[0].frequencies[0]) ** 2

    rest = square(0.0)
    assert square(0.5) / rest == pytest.approx(0.5, abs=3e-3)
    assert square(-0.5) / rest == pytest.approx(1.5, abs=3e-3)


@pytest.mark.thorough
@kinds
def test_a_warm_strip_between_walls_vibrates_as_a_beam(kind):
    """A plate and a beam without contraction across, clamped at both ends, pressed by a quarter of their critical load."""
    change = 0.25 * 4.0 * math.pi**2 * I_Y / (0.5**2 * AREA * ALPHA)
    mesh = mbd.mesh.rectangle(0.5, SIDE[0], (12, 2), kind=kind)
    options: dict = {"stiffening": True, "reduction": "craig-bampton", "expansion": True}

    def shares(make: Any, at: float, start: str, end: str) -> float:
        squares = []
        for x in (0.0, change):
            body = make()
            walls = [mbd.Fixed(GROUND.at(at, 0, 0), body.at(start)), mbd.Fixed(GROUND.at(at + 0.5, 0, 0), body.at(end))]
            system = mbd.System([body], walls, [mbd.Temperature(body, x)], truncation=None)
            squares.append(float(mbd.equilibrium(system).vibrations[0].frequencies[0]) ** 2)
        return squares[1] / squares[0]

    def plate() -> mbd.FlexibleBody:
        laminate, ends = mbd.Laminate(STEEL, [0.0], SIDE[1]), {"tip": "right_edge"}
        return mbd.FlexibleBody.plate("strip", mesh, laminate, 5, reference="left_edge", interface=ends, **options)

    measured = shares(plate, -0.25, "left_edge", "tip")
    expected = shares(lambda: bar(elements=12, modes=5, interface="end", **options), 0.0, "start", "end")
    assert measured == pytest.approx(expected, abs=4e-3)
    assert expected == pytest.approx(0.757, abs=2e-3)


@pytest.mark.thorough
def test_the_pressure_of_a_warm_beam_between_walls_is_reported():
    """The share of the load E A alpha T of the one at which the body buckles, held at its reference, pi^2 E I / (2 L)^2."""
    change = 0.5 * math.pi**2 * I_Y / (0.5**2 * AREA * ALPHA)
    body = bar(elements=8, modes=4, damping=1e-4)
    hinges = [mbd.Revolute(GROUND.at(x, 0, 0), body.at(end), "y") for x, end in ((0.0, "start"), (0.5, "end"))]
    system = mbd.System([body], hinges, [mbd.Temperature(body, change)], truncation=None)
    with warned("2 of its stiffness", kind=mbd.errors.LoadWarning):
        motion = mbd.simulate(system, 0.02, steps=10, backend="eager", start="equilibrium")
    assert motion.stats["load_share"]["bar"] == pytest.approx(4.0 * 0.5, rel=1e-2)


@pytest.mark.thorough
def test_changes_may_share_a_variable():
    """Their histories are those of two variables of the same value."""
    plate = strip(mbd.Laminate(CARBON, mbd.deg([0, 90]), 0.125e-3))
    stresses = []
    for second in (None, mbd.variable(2.0)):
        v: Any = mbd.variable(2.0)
        w: Any = v if second is None else second
        heat = mbd.Temperature(
            plate, mbd.forces.Scaled(v, lambda t: 3.0 + t), mbd.forces.Scaled(w, lambda t: 100.0 - t), name="heat"
        )
        assert len(heat.law_variables.numbers) == (1 if second is None else 2)
        stresses.append(mbd.PlyHistory(mbd.equilibrium(held(plate, heat)), "strip").stress().detach())
    assert float(stresses[1].abs().max()) > 1e4
    assert_close(stresses[0], stresses[1], rtol=1e-9, atol=1e-3)


def test_the_coefficient_of_a_section_is_a_design_variable():
    """The tip of a free bar, L alpha T, and its derivative L T."""
    numbers = (0.3, 7850.0, AREA, I_Y, 16.0 * I_Y, 3.0 * I_Y)
    body = bar(mbd.GivenSection.isotropic(E, *numbers, alpha=mbd.variable(ALPHA)))
    system = held(body, mbd.Temperature(body, 30.0))
    values = tensor(ALPHA, 0.0, 2.0 * ALPHA).requires_grad_()
    options: dict = {"steps": 2, "backend": "eager", "start": "equilibrium", "designs": {"bar.section.alpha": values}}
    tips = mbd.simulate(system, 1e-3, **options).require_ok().body("bar").at("end").position[:, -1, 0]
    assert_close(tips.detach() - 0.5, 0.5 * 30.0 * values.detach(), rtol=1e-6, atol=1e-15)
    (slope,) = torch.autograd.grad(tips[[0, 2]].sum(), values)
    assert_close(slope, tensor(15.0, 0.0, 15.0), rtol=1e-6, atol=0)


SIZES = (1e-4, 1e-7, 1e-3, 0.1)  # steps of differences, of the unknowns of the next test


def heated() -> mbd.System:
    """An unbalanced plate that swings under gravity and a rising temperature, all numbers of which vary."""
    ply = mbd.Ply(128e6, 10.1e6, 5.36e6, 5.36e6, 3.6e6, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=mbd.variable(28e-5))
    laminate = mbd.Laminate(ply, mbd.deg([20, -50, 75]), [0.9e-3, 0.7e-3, 0.8e-3])
    mesh = mbd.mesh.rectangle(0.2, 0.05, (3, 2))
    options: dict = {"reference": "left_edge", "expansion": True, "stiffening": True}
    body = mbd.FlexibleBody.plate("rod", mesh, laminate, 2, **options)
    factor: Any = mbd.variable(0.3)
    rising = mbd.forces.Scaled(factor, lambda t: torch.sin(30.0 * t))
    heat = mbd.Temperature(body, rising, gradient=mbd.variable(100.0), name="heat")
    body.position.copy_(tensor(-0.1, 0.0, 0.0))
    hinge = mbd.Revolute(GROUND.at(-0.1, 0, 0), body.at("left_edge"), "y")
    return mbd.System([body], [hinge], [heat], gravity=(0.0, 0.0, -9.81), truncation=None)


@pytest.mark.thorough
def test_gradients_forward_reverse_and_by_differences():
    """Displacements and ply stresses are differentiated by angles, a coefficient and two changes.

    Compiled code makes the differences.
    """
    system = heated()
    names = ["rod.laminate.angles", "rod.laminate.ply.alpha2", "heat.temperature", "heat.gradient"]
    values = [system.get_parameter(name).detach().clone() for name in names]
    directions = [
        h * torch.linspace(1.0, 2.0, x.numel(), dtype=x.dtype).reshape(x.shape)
        for h, x in zip(SIZES, values, strict=True)
    ]

    def measured(*x: Tensor, backend: str = "eager") -> Tensor:
        options: dict = {"steps": 6, "backend": backend, "iterations": (7, 7), "refresh": 1}
        motion = mbd.simulate(system, 0.015, designs=dict(zip(names, x, strict=True)), **options)
        tip = motion.body("rod").at("right").position[:, -1]
        stress = mbd.PlyHistory(motion, "rod").stress(slice(-1, None))[:, 0, ::7, :3]
        return torch.cat([100.0 * tip, stress.flatten(1) / 1e4], 1)

    lanes = [x.expand(16, *x.shape).clone() for x in values]
    for k, direction in enumerate(directions):
        for i, times in enumerate((1.0, -1.0, 2.0, -2.0)):
            lanes[k][4 * k + i] += times * direction
    ends = measured(*lanes, backend="native").detach().unflatten(0, (4, 4)).unbind(1)
    differences = (8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12.0
    leaves = [x.clone().requires_grad_() for x in values]
    weights = torch.cos(torch.arange(differences.shape[1], dtype=torch.float64))
    reverse = torch.autograd.grad((measured(*leaves)[0] * weights).sum(), leaves)
    forward: Any = torch.func.jvp(measured, tuple(values), tuple(directions))[1]
    together = differences.sum(0)
    assert_close(forward[0], together, rtol=0, atol=1e-6 * float(together.abs().max()))
    for name, bar, direction, column in zip(names, reverse, directions, differences, strict=True):
        size = float((column * weights).abs().max())
        assert size > 0.0, name
        assert float((bar * direction).sum()) == pytest.approx(float(column @ weights), abs=1e-6 * size)
    total = sum(float((bar * direction).sum()) for bar, direction in zip(reverse, directions, strict=True))
    assert total == pytest.approx(float(forward[0] @ weights), rel=1e-8)


def test_modes_without_the_shape_are_reported():
    """Few vibration modes have no stretching: the share of the work that is missing, and none with expansion=True."""
    laminate = mbd.Laminate(CARBON, mbd.deg([0, 90]), 0.2e-3, symmetric=True)
    shares = []
    for expansion in (False, True):
        mesh = mbd.mesh.rectangle(0.2, 0.05, (4, 2))
        body = mbd.FlexibleBody.plate("panel", mesh, laminate, 3, reference="left", expansion=expansion)
        hold = mbd.Fixed(GROUND.at(-0.1, 0, 0), body.at("left"))
        body.position.copy_(tensor(-0.1, 0.0, 0.0))
        truncation = mbd.static_truncation(mbd.System([body], [hold], [mbd.Temperature(body, 10.0)]))
        assert isinstance(truncation, StaticTruncation)
        shares.append(truncation.share)
        if not expansion:
            assert "deflection of body 'panel' under a change of temperature; better: expansion=True" in str(truncation)
    assert shares[0] > 0.99
    assert abs(shares[1]) < 1e-9


def test_a_body_is_checked_again_when_it_becomes_warm():
    """It was simulated without heat before; the advice names the zone, beside the shapes that the body has."""
    mesh = mbd.mesh.rectangle(0.2, 0.02, (4, 2))
    upper = mesh.nodes[mesh.quads].mean(1)[:, 1] > 0.0
    plates = {
        name: mbd.fem.elements.Plates(mesh, mbd.Laminate(STEEL, [0.0], 1e-3), cells=torch.nonzero(x)[:, 0])
        for name, x in (("upper", upper), ("lower", ~upper))
    }
    for expansion, advice in ((False, "expansion='upper'"), (True, "expansion=[True, 'upper']")):
        body = mbd.FlexibleBody("panel", mesh, plates, 2, reference="left", expansion=expansion, position=(-0.1, 0, 0))
        hold = mbd.Fixed(GROUND.at(-0.1, 0, 0), body.at("left"))
        warn_static_truncation(mbd.System([body], [hold]))
        warm = mbd.System([body], [hold], [mbd.Temperature(body, 5.0, zone="upper")])
        with warned(f"temperature of part 'upper'; better: {advice} of the body"):
            warn_static_truncation(warm)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warn_static_truncation(warm)
    both = mbd.FlexibleBody("panel", mesh, plates, 2, reference="left", expansion=[True, "upper"])
    assert both.expansion.loads == [(zone, x) for zone in (None, "upper") for x in ("temperature", "gradient")]


def test_parts_that_do_not_expand_are_named():
    mesh = mbd.mesh.rectangle(0.2, 0.02, (4, 2))
    k = 1e6 * tensor(1.0, -1.0, -1.0, 1.0).reshape(1, 2, 2)
    ends = torch.tensor([[6 * mesh.node("left"), 6 * mesh.node("right")]])
    parts = {
        "skin": mbd.fem.elements.Plates(mesh, mbd.Laminate(STEEL, [0.0], 1e-3)),
        "rod": mbd.fem.elements.GivenElements(mesh, [ends], [k]),
    }
    body = mbd.FlexibleBody("panel", mesh, parts, 2, reference="left", expansion=True)
    with warned("its parts 'rod' ignore it"):
        mbd.Temperature(body, 50.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mbd.Temperature(body, 50.0, zone="skin")


def test_a_temperature_without_a_change_does_nothing():
    body = strip(mbd.Laminate(STEEL, [0.0], 1e-3))
    result = mbd.equilibrium(held(body, mbd.Temperature(body)))
    assert changes_of(result, body) == []
    assert float(mbd.PlyHistory(result, "strip").stress().detach().abs().max()) == 0.0


def test_shapes_that_modes_or_others_have_are_not_added_twice():
    """Moisture of a metal expands it as temperature does: one shape."""
    metal = mbd.Ply.isotropic(70e9, 0.3, 2700.0, alpha=23e-6, beta=0.1)
    body = skewed(mbd.Laminate(metal, [0.0], 1e-3), "quad")
    bare = mbd.FlexibleBody.plate("panel", body.mesh, mbd.Laminate(metal, [0.0], 1e-3), 2, reference=5)
    assert len(body.expansion.loads) == 3
    assert body.modes == bare.modes + 2
    assert body.modes in body.mode_counts
    wet, warm = mbd.Temperature(body, moisture=0.003), mbd.Temperature(body, 0.003 * 0.1 / 23e-6)
    assert_close(displacements(body, wet), displacements(body, warm), rtol=0, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("first", [40.0, 45.0])
def test_designs_of_one_batch_have_as_many_shapes_as_each_needs(first):
    """[45, -45] has one shape of temperature and moisture, its neighbors have two: all are exact, whatever was built."""
    angles = mbd.deg([[40.0, -40.0], [44.9, -44.9], [45.0, -45.0]])
    body = strip(mbd.Laminate(CARBON, mbd.deg([first, -first]), 0.25e-3, symmetric=True))
    system = held(body, mbd.Temperature(body, lambda t: 10.0 + 0.0 * t, moisture=0.001))
    designs = {"strip.laminate.angles": angles}
    motion = mbd.simulate(system, 1e-3, steps=2, backend="eager", start="equilibrium", designs=designs).require_ok()
    shifts = motion.body("strip").at("right").position[:, -1, 0].detach() - 0.1
    for x, design in zip(shifts, angles, strict=True):
        free = mbd.Laminate(CARBON, design, 0.25e-3, symmetric=True).expansion(10.0, 0.0, 0.001)
        assert float(x) == pytest.approx(0.2 * float(free.strain[0]), rel=1e-6)

    def shift(angles: Tensor) -> Tensor:
        options: dict = {
            "steps": 2,
            "backend": "eager",
            "start": "equilibrium",
            "designs": {"strip.laminate.angles": angles},
        }
        return mbd.simulate(system, 1e-3, **options).body("strip").at("right").position[0, -1, 0] - 0.1

    with warned("of its own in design 2 for a change of moisture:"):
        assert_close(torch.func.vmap(shift)(angles), shifts, rtol=1e-9, atol=0)


@pytest.mark.parametrize("first", [40.0, 45.0])
def test_designs_that_lose_a_shape_are_told(first):
    """At [45, -45] moisture has the shape of temperature, beside it not: its gradient there lacks a part. A metal has no such
    design, motions without gradients need no warning, and a coefficient of zero is one."""
    body = strip(mbd.Laminate(CARBON, mbd.deg([first, -first]), 0.25e-3, symmetric=True))
    system = held(body, mbd.Temperature(body, 1.0, moisture=0.001))
    options: dict = {"steps": 2, "backend": "eager", "start": "equilibrium", "diagnose": False}
    angles = mbd.deg([[40.0, -40.0], [45.0, -45.0]])

    def moved(angles: Tensor, name: str = "strip.laminate.angles", system: Any = system) -> Any:
        return mbd.simulate(system, 1e-3, designs={name: angles}, **options).require_ok()

    with warned("'strip' has no static shape of its own in design 1 for a change of moisture:"):
        moved(angles.clone().requires_grad_())
    with warned("of its own for a change of moisture:"):
        moved(angles[1].clone().requires_grad_())
    metal = mbd.Ply.isotropic(70e9, 0.3, 2700.0, alpha=23e-6, beta=0.1)
    plate = strip(mbd.Laminate(metal, mbd.deg([45.0, -45.0]), 0.25e-3))
    heated = held(plate, mbd.Temperature(plate, 1.0, moisture=0.001))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        moved(angles)
        moved(angles[:1].clone().requires_grad_())
        moved(angles[1:].clone().requires_grad_(), system=heated)
    numbers = (0.3, 7850.0, AREA, I_Y, 16.0 * I_Y, 3.0 * I_Y)
    rod = bar(mbd.GivenSection.isotropic(E, *numbers, alpha=mbd.variable(ALPHA)))
    values = tensor(0.0, ALPHA).requires_grad_()
    with warned("'bar' has no static shape of its own in design 0 for a change of temperature, gradient, gradient_y:"):
        moved(values, "bar.section.alpha", held(rod, mbd.Temperature(rod, 30.0)))


@pytest.mark.thorough
def test_a_finer_mesh_and_more_modes_have_the_same_expansion():
    body = strip(mbd.Laminate(CARBON, mbd.deg([0, 90]), 0.125e-3))
    system = held(body, mbd.Temperature(body, lambda t: 1.0 + 0.1 * t))
    motion = mbd.simulate(system, 0.02, steps=10, backend="eager", start="equilibrium")
    response = mbd.Final(mbd.Displacement("strip", "z", node="right"))
    error = motion.error_of(response)
    assert error.by_mesh is not None
    assert error.by_modes is not None
    assert float(error.by_mesh.abs()) < 1e-3 * float(error.value.abs())
    assert float(error.by_modes.abs()) < 1e-3 * float(error.value.abs())


def test_bad_changes_are_named():
    bare = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0)
    body = skewed(mbd.Laminate(CARBON, [0.0], 1e-3), "quad")
    cold = mbd.FlexibleBody.plate("cold", body.mesh, mbd.Laminate([CARBON, bare], [0.0, 0.3], 1e-3), 2)
    steel = mbd.GivenSection.isotropic(E, 0.3, 7850.0, AREA, I_Y, I_Y, 2.0 * I_Y)
    line = mbd.BeamLine.straight(0.5, 2)
    cured = mbd.FlexibleBody.beam(
        "cured", line, mbd.sections.rectangle(*SIDE, bare, cells=(2, 2)), 1, reference="start"
    )
    exact = mbd.FlexibleBeam("hose", line, steel)
    box = mbd.RigidBody("box", 1.0, (1.0, 1.0, 1.0))
    wrong: list[tuple[Any, tuple[Any, ...]]] = [
        (
            lambda: mbd.Temperature(box, 1.0),
            ("body", ANY, "body of Temperature = 'box': must be a flexible body of plates or beams"),
        ),
        (lambda: mbd.Temperature("p", 1.0), ("body", "p", "body of Temperature = 'p': must be a flexible body")),
        (lambda: mbd.Temperature(exact, 1.0), ("body", ANY, "body of Temperature = 'hose'")),
        (lambda: mbd.Temperature(body, 1.0, zone=3), ("panel.zone", 3, "plate")),  # pyright: ignore
        (lambda: mbd.Temperature(body, 1.0, zone=["plate"]), ("panel.zone", ["plate"])),  # pyright: ignore
        (
            lambda: skewed(body.plates["plate"].laminate, "quad", expansion=["plate", "plate"]),
            ("panel.expansion", ["plate", "plate"]),
        ),
        (lambda: skewed(body.plates["plate"].laminate, "quad", expansion=[None]), ("panel.expansion", [None])),
        (
            lambda: mbd.Temperature(cured, 1.0),
            ("cured.section0.alpha1", ANY, "layer 0 of the section", "no alpha1 and no alpha2"),
        ),
        (lambda: mbd.Temperature(body, float("nan")), ("temperature_panel.temperature", math.nan)),
        (lambda: mbd.Temperature(body, lambda t: t / 0.0 * 0.0), ("temperature_panel.law", ANY, "finite")),
        (lambda: mbd.Temperature(body, "hot"), ("temperature_panel.temperature", "hot")),  # pyright: ignore
        (lambda: mbd.Temperature(body, gradient_y=2.0), ("temperature_panel.gradient_y", ANY, "gradient, moisture")),
        (lambda: mbd.Temperature(body, 1.0, zone="skin"), ("panel.zone", "skin", "plate")),
        (
            lambda: mbd.Temperature(cold, 1.0),
            ("cold.plate.alpha1", ANY, "part 'plate' of body 'cold'", "layer 1", "no alpha1"),
        ),
        (
            lambda: mbd.Temperature(bar(), moisture=0.1),
            ("bar.section0.coefficient of moisture expansion", ANY, "part 'section0' of body 'bar'"),
        ),
        (lambda: bar(steel), ("bar.expansion.bar.section0.alpha", ANY, "expansion of 'bar'")),
        (lambda: bar(expansion=["section7"]), ("bar.zone", "section7")),
        (lambda: bar(expansion=3), ("bar.expansion", 3)),
        (
            lambda: mbd.GivenSection.isotropic(E, 0.3, 7850.0, AREA, I_Y, I_Y, 2.0 * I_Y, alpha=float("inf")),
            ("alpha", math.inf),
        ),
    ]
    for make, said in wrong:
        with refused(*said):
            make()


def test_stresses_need_one_law_for_the_whole_motion():
    body = strip(mbd.Laminate(CARBON, mbd.deg([0, 90]), 0.125e-3))
    system = held(body, mbd.Temperature(body, lambda t: torch.sin(t), name="heat"))
    phases = [mbd.Phase(until=0.005), mbd.Phase(laws={"heat": mbd.forces.OfTime(1.0)})]
    with_phases = mbd.simulate(system, 0.01, steps=4, phases=phases, backend="eager")
    with refused("phases.laws", "heat"):
        mbd.PlyHistory(with_phases, "strip")
