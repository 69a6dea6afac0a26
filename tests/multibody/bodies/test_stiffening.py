"""Displacements of second order against the shortening of a bent line, rigid turns, and derivatives against differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.fem.elements import BeamLine, GivenSection

L, AREA, I, RHO, E = 2.0, 1e-3, 1e-7, 2700.0, 7e10
SECTION = GivenSection.isotropic(E, 0.3, RHO, AREA, I, 4 * I, 5 * I)


def beam(elements: int = 40, modes: int = 4, **given) -> mbd.FlexibleBody:
    return mbd.FlexibleBody.beam(
        "beam", BeamLine.straight(L, elements), SECTION, modes=modes, reference="start", stiffening=True, **given
    )


@pytest.mark.thorough
@torch.no_grad()
def test_a_bent_line_is_shorter():
    """f_x = - integral of u2' u2' + u3' u3' from the reference, at the end and in the sums over the mass."""
    body = beam(elements=80)
    result = body.structure(nodes=[80])
    psi, h = result["psi"], L / 80
    slope = (psi[1:, 1:3] - psi[:-1, 1:3]) / h  # [elements, 2, m]
    rate = -torch.einsum("eia,eib->eab", slope, slope) * h
    shortening = torch.cat([torch.zeros(1, 4, 4), rate.cumsum(0)])
    assert_close(result["psi2"][0, 0], shortening[-1], rtol=2e-3, atol=2e-3 * float(shortening[-1].abs().max()))
    mass = torch.full((81,), RHO * AREA * h, dtype=torch.float64)
    mass[[0, -1]] *= 0.5
    F1, x = torch.einsum("k,kab->ab", mass, shortening), body.mesh.nodes[:, 0]
    F2 = torch.einsum("k,kab->ab", mass * x, shortening)
    assert_close(result["F1"][0], F1, rtol=2e-3, atol=2e-3 * float(F1.abs().max()))
    assert_close(result["F2"][0, 0], F2, rtol=2e-3, atol=2e-3 * float(F2.abs().max()))
    assert_close(result["F2"], result["F2"].mT)


@torch.no_grad()
def test_a_soft_hinge_turns_its_arm_as_a_rigid_body():
    """A short soft element carries a long stiff arm, which turns by rotation vectors: x = phi x d + 1/2 phi x (phi x d)."""
    soft, a = 1e-7, 0.01
    nodes = torch.tensor([[0.0, 0.0, 0.0], [a, 0.0, 0.0], [a + 0.7, 0.2, -0.1]], dtype=torch.float64)
    line = BeamLine(nodes, torch.tensor([[0, 1], [1, 2]]))
    sections = [GivenSection(soft * SECTION.stiffness(), SECTION.mass()), SECTION]
    body = mbd.FlexibleBody.beam("arm", line, sections, modes=6, reference=0, stiffening=True)
    result = body.structure(nodes=[1, 2])
    phi, psi2 = result["psi"][1, 3:], result["psi2"]
    d = (nodes[2] - nodes[1])[:, None, None].expand(3, 6, 6)

    def turned(x: Tensor, y: Tensor) -> Tensor:
        return torch.linalg.cross(x.expand(3, 6, 6), y, dim=0)

    twice = turned(phi[:, :, None], turned(phi[:, None, :], d))
    expected = psi2[0, :3] + turned(psi2[0, 3:], d) + 0.5 * (twice + twice.mT)
    assert_close(psi2[1, :3], expected, rtol=0.0, atol=1e-4 * float(expected.abs().max()))


FLAPPING = {  # frequencies sqrt(m L4 / EI) om_k over spin, A. D. Wright and others, J. Appl. Mech. 49 (1982) 197-202
    0.0: (3.5160, 22.0345, 61.6972),
    3.0: (4.7973, 23.3203, 62.9850),
    6.0: (7.3604, 26.8091, 66.6840),
    12.0: (13.1702, 37.6031, 79.6145),
}


@pytest.mark.thorough
@torch.no_grad()
@pytest.mark.parametrize("spin", FLAPPING)
def test_frequencies_of_a_rotating_cantilever(spin: float):
    """Flapping as published; lagging om^2 below; torsion of a flat section as a tennis racket, om^2 (I3 - I2) / (I3 + I2)."""
    EI = 1e3
    stiffness = torch.diag(torch.tensor([1e9, 1e9, 1e9, 1e2, 2 * EI, EI], dtype=torch.float64))
    inertia = torch.diag(torch.tensor([1.0, 1.0, 1.0, 4e-5, 0.5e-5, 3.5e-5], dtype=torch.float64))
    line, options = BeamLine.straight(1.0, 30), {"modes": 12, "reference": "start", "mass": "consistent"}
    body = mbd.FlexibleBody.beam("blade", line, GivenSection(stiffness, inertia), stiffening=True, **options)
    result, om = body.structure(), spin * EI**0.5

    def squares(axis: int, component: int, number: int, om: float = om) -> Tensor:
        """Of the lowest frequencies of modes that move by one component."""
        Z = torch.eye(3, dtype=torch.float64) * -(om**2)
        Z[axis, axis] = 0.0
        K = result["Kr"] + torch.einsum("ij,ijab->ab", Z, result["C1"] + result["F2"])
        values, shapes = torch.linalg.eigh(K)
        share = torch.einsum("nia,ab->nib", result["psi"], shapes).square().sum(0)[component]
        return values[share > 0.1 * share.max()][:number]

    flap, lag = squares(1, 1, 3), squares(2, 1, 3)  # along y, spin about y and z
    expected = torch.tensor(FLAPPING[spin], dtype=torch.float64)
    assert_close(flap.sqrt() / EI**0.5, expected, rtol=4e-3, atol=0.0)
    assert_close(lag, flap - om**2, rtol=4e-3, atol=0.0)
    for axis, sign in ((1, -1.0), (2, 1.0)):
        change = squares(axis, 3, 1) - squares(axis, 3, 1, 0.0)
        assert_close(change, torch.full((1,), sign * 0.75 * om**2).double(), rtol=1e-2, atol=1e-3)


def root_torque(scale: float, kind: str) -> Tensor:
    """Of a beam that couples bending with torsion, under a force on an arm at its end, one inside and a spring there."""
    K = torch.diag(torch.tensor([2e6, 5e5, 4e5, 60.0, 100.0, 400.0], dtype=torch.float64))
    for (i, j), x in {(3, 4): 35.0, (3, 5): -30.0, (4, 5): 60.0}.items():
        K[i, j] = K[j, i] = x
    section = GivenSection(K, torch.diag(torch.tensor([1.0, 1.0, 1.0, 8e-4, 2e-4, 6e-4])))
    line, ground, arm = BeamLine.straight(1.0, 8), mbd.Ground(), (0.05, 0.2, -0.15)
    bodies, joints = [], []
    if kind == "exact":
        body = mbd.FlexibleBeam("beam", line, section)
        tip = mbd.RigidBody("tip", 1e-3, (1e-6, 1e-6, 1e-6), position=(1.0, 0.0, 0.0))
        bodies, joints, end = [tip], [mbd.Fixed(body.at("end"), tip.at())], tip.at(*arm)
    else:
        options: dict = {"reduction": "craig-bampton", "interface": (4, "end"), "modes": 6, "reference": "start"}
        body = mbd.FlexibleBody.beam("beam", line, section, stiffening=kind == "stiffened", **options)
        end = body.at("end", offset=arm)
    joints.append(mbd.Fixed(ground.at(), body.at("start"), name="wall"))
    forces = [
        mbd.Force(end, (60.0 * scale, 10.0 * scale, 14.0 * scale), axes="frame"),
        mbd.Force(body.at(4), (0.0, 5.0 * scale, -20.0 * scale)),
        mbd.SpringDamper(ground.at(0.5, 0.4, 0.1), body.at(4), stiffness=100.0 * scale, rest=0.1),
    ]
    rest = mbd.equilibrium(mbd.System([body, *bodies], joints, forces, truncation=None))
    return rest.reaction("wall").torque[0, 0] / scale


@pytest.mark.thorough
@torch.no_grad()
def test_reactions_under_forces_on_arms_and_inside_are_of_second_order():
    """Against exact beams: errors fall with the square of the load, and are a twentieth of those without stiffening."""
    errors = {}
    for scale in (0.25, 0.5):
        exact = root_torque(scale, "exact")
        for kind in ("stiffened", "linear"):
            errors[kind, scale] = float((root_torque(scale, kind) - exact).norm() / exact.norm())
    assert errors["stiffened", 0.5] < 0.05 * errors["linear", 0.5]
    assert errors["stiffened", 0.5] / errors["stiffened", 0.25] > 3.3


def test_bodies_without_stress_are_refused():
    with refused("beam.stiffening", 1):
        mbd.FlexibleBody.beam("beam", BeamLine.straight(L, 2), SECTION, reference="start", stiffening=1)  # type: ignore
    with refused("stiffening", True):
        beam(4).save_reduced("beam.npz")
