"""Beam elements between bodies: no force under rigid motions, the exact matrix, conserved energy and momentum."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.math.pair import Pair
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.equations import beams, equations
from torchmbd.multibody.saddle.blocks import Slopes

SECTION = mbd.GivenSection.isotropic(E=70e9, nu=0.3, density=2700.0, area=1e-4, Iyy=1e-9, Izz=2e-9, J=2e-9)
TURN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def coupled() -> torch.Tensor:
    """Stiffness of an element in which everything is coupled [6, 6]."""
    g = torch.Generator().manual_seed(1)
    L = torch.eye(6, dtype=torch.float64) + 0.3 * torch.randn(6, 6, generator=g, dtype=torch.float64)
    return 1e3 * L @ L.T


def chain(damping: float = 0.0, stiffness=None, forces=()) -> mbd.System:
    """Two free bodies behind a third, whose frames have arms and axes of their own."""
    at = [(0.0, 0, 0), (0.5, 0.1, 0), (0.9, 0, 0.2)]
    a, b, c = (
        mbd.RigidBody(n, 1.0 + k, (0.01, 0.02, 0.02), (0.01, 0.02 * k, 0), x, velocity=(0.1 * k, 1.0 - k, 0.3))
        for k, (n, x) in enumerate(zip("abc", at, strict=True))
    )
    K = coupled() if stiffness is None else stiffness
    elements = [
        mbd.BeamElement(a.at(0.05, 0, 0), b.at(-0.1, 0, 0.05, axes=TURN), K, damping, name="first"),
        mbd.BeamElement(b.at(0.1, 0, 0), c.at(), 2.0 * coupled(), damping, name="second"),
    ]
    return mbd.System([a, b, c], forces=elements, free=["a", "b", "c"])


def state(T, seed: int):
    """A position with large rotations, and rates."""
    g = torch.Generator().manual_seed(seed)
    n = T.bodies
    r = torch.tensor([[0.0, 0.5, 0.9], [0, 0.1, 0], [0, 0, 0.2]], dtype=torch.float64)
    p = torch.randn(4, n, generator=g, dtype=torch.float64) * 0.3
    p[0] = 1.0
    p = p / p.norm(dim=0)
    q = torch.cat([r.flatten(), p.flatten()])[:, None, None]
    return q, torch.randn(T.n_v, generator=g, dtype=torch.float64)[:, None, None]


def test_no_force_under_rigid_motion():
    dynamics = chain().dynamics()
    T, data = dynamics.topology, dynamics.data
    q, _ = dynamics.initial.solve(dynamics)
    p = torch.tensor([0.2, -0.7, 0.5, 0.4], dtype=torch.float64)
    p = p / p.norm()
    A = rotation_matrix(p[:, None, None])[:, :, 0, 0]
    r = A @ q[:9, 0, 0].reshape(3, 3) + torch.tensor([[3.0], [-2.0], [1.0]], dtype=torch.float64)
    moved = torch.cat([r.flatten(), p.repeat_interleave(3)])[:, None, None]
    at = equations.placement(T, data, moved, T.prescribed(torch.zeros((), dtype=torch.float64)))
    force, torque = beams.resistance(T, data, at, None)
    assert float(force.abs().max()) < 1e-9
    assert float(torque.abs().max()) < 1e-9


@pytest.mark.parametrize("damping", [0.0, 0.02])
def test_matrix_is_the_derivative_of_the_residual(damping):
    dynamics = chain(damping).dynamics()
    T, data = dynamics.topology, dynamics.data
    q, v = state(T, 0)
    still, none = 0.0 * v, v[:0]
    given = T.prescribed(torch.zeros((), dtype=torch.float64))
    at = equations.placement(T, data, q, given)
    unit = Pair.of(still, torch.eye(T.n_v, dtype=torch.float64)[..., None])
    moved = equations.placement(T, data, equations.advance(T, q, unit), given)
    expected = equations.dynamic_residual(T, data, moved, still, still, none).tangent[..., 0]
    mass = dynamics.saddle.matrix(data, at, Slopes(v=still, lam=none))[0]
    result = dynamics.saddle.matrix(data, at, Slopes(1.0, 0.0, still, still, none))[0] - mass
    assert_close(result, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    expected = equations.dynamic_residual(T, data, moved, v, still, none).tangent[..., 0]
    result = dynamics.saddle.matrix(data, at, Slopes(1.0, 0.0, v, still, none))[0] - mass
    assert_close(result, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    rate = Pair.of(v, torch.eye(T.n_v, dtype=torch.float64)[..., None])
    expected = equations.dynamic_residual(T, data, at, rate, still, none).tangent[..., 0]
    result = dynamics.saddle.matrix(data, at, Slopes(0.0, 1.0, v, still, none))[0] - mass
    assert_close(result, expected, rtol=1e-9, atol=1e-9 * max(1.0, float(expected.abs().max())))


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled")
def test_energy_is_kept():
    options: dict = {"spectral_radius": 0.9}  # that of 0.6 takes more energy
    coarse, fine = (mbd.simulate(chain(), 0.5, steps=n, **options).energies for n in (150, 300))
    drift = [float((e.stored - e.stored[:, :1]).abs().max()) for e in (coarse, fine)]
    assert float(fine.strain.max()) > 0.01 * float(fine.stored[0, 0])
    assert drift[1] < 1e-3 * float(fine.stored[0, 0])
    assert drift[1] < drift[0] / 2.5


@pytest.mark.thorough
def test_dampers_take_energy():
    coarse, fine = (mbd.simulate(chain(0.02), 0.25, steps=n, backend="eager").energies for n in (125, 250))
    assert float(fine.dissipated[0, -1]) > 0.03 * float(fine.stored[0, 0])
    assert float(fine.balance.abs().max()) < 0.02 * float(fine.stored[0, 0])
    assert float(fine.balance.abs().max()) < float(coarse.balance.abs().max()) / 3.0


@pytest.mark.thorough
def test_a_system_of_the_parts_of_another():
    """Whose bodies are the nodes of its beams, and whose forces their elements."""
    ground, beam = mbd.Ground(), mbd.FlexibleBeam("beam", mbd.BeamLine.straight(1.0, elements=2), SECTION)
    tip = mbd.RigidBody("tip", 1.0, (0.1, 0.1, 0.1), position=(1.0, 0.0, 0.0))
    joints = [mbd.Fixed(ground.at(), beam.at("start")), mbd.Fixed(beam.at("end"), tip.at())]
    one = mbd.System([tip, beam], joints)
    other = mbd.System(one.bodies, one.joints, one.forces, gravity=(0.0, 0.0, -9.81))
    assert other.beams == one.beams
    assert [body.name for body in other.bodies] == [body.name for body in one.bodies]
    assert len(other.forces) == 1
    assert mbd.equilibrium(other).body("beam").displacements[0, 0, -1, 2] < 0.0
