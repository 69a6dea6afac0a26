"""Static equilibrium and small vibrations: pendulums in closed form, a swinging beam, and what has no equilibrium."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, pendulum, plate, turned
from tests.refused import ANY, refused
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equilibrium.linearized import Linearization

G = 9.81


def double_pendulum(first: float = 0.0, second: float = 0.0, **more) -> mbd.System:
    """Two bars about z at angles [rad] from the vertical, with the data of `BARS`."""
    ground, bodies, joints = mbd.Ground(), [], []
    hook, at = ground.at(), torch.zeros(3, dtype=torch.float64)
    for name, angle, (m, c, length, J) in zip("ab", (first, second), BARS, strict=True):
        A = turned(0.0, 0.0, angle)
        body = mbd.RigidBody(name, m, (J, J / 9, J), center=(0.0, -c, 0.0), position=at, axes=A)
        joints.append(mbd.Revolute(hook, body.at(), "z"))
        hook, at = body.at(0.0, -length, 0.0), at + A @ torch.tensor([0.0, -length, 0.0]).double()
        bodies.append(body)
    return mbd.System(bodies, joints, gravity=(0.0, -G, 0.0), **more)


BARS = ((1.3, 0.4, 0.7, 0.09), (0.8, 0.25, 0.5, 0.02))  # mass, distance of its center, length, inertia about the center


def frequencies_of_the_double_pendulum() -> list[float]:
    (m1, c1, l1, J1), (m2, c2, _, J2) = BARS
    M = [[J1 + m1 * c1**2 + m2 * l1**2, m2 * l1 * c2], [m2 * l1 * c2, J2 + m2 * c2**2]]
    squares = scipy.linalg.eigh(np.diag([(m1 * c1 + m2 * l1) * G, m2 * c2 * G]), M, eigvals_only=True)
    return (np.sqrt(squares) / (2 * math.pi)).tolist()


@pytest.mark.parametrize("start", [(0.0, 0.0), (2.5, -1.0), (-1.2, 3.0)])
def test_a_double_pendulum_hangs_down_and_swings(start):
    result = mbd.equilibrium(double_pendulum(*start))
    assert result.stable
    assert result.vibrations[0].frequencies.tolist() == pytest.approx(frequencies_of_the_double_pendulum(), rel=1e-9)
    p = result.q[0, 0, 6:14].reshape(4, 2)
    assert_close(rotation_matrix(p)[..., 0], torch.eye(3).double(), rtol=0, atol=1e-9)
    weight = sum(m for m, *_ in BARS) * G
    assert float(result.lam.norm(dim=-1).max()) > weight  # of both hinges


def test_upside_down_is_an_unstable_equilibrium():
    result = mbd.equilibrium(double_pendulum(math.pi, math.pi))
    assert not result.stable
    growth = float(result.vibrations[0].poles.real.max())
    assert growth == pytest.approx(2 * math.pi * max(frequencies_of_the_double_pendulum()), rel=1e-9)


def beam(weight: float) -> mbd.System:
    """A steel bar hung at its end by a hinge; `weight`: gravity [m/s2]."""
    line, down = mbd.BeamLine.straight(1.0, 48), turned(0.0, 0.0, -math.pi / 2)
    section = mbd.GivenSection.isotropic(E=2.1e11, nu=0.3, density=7800.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)
    body = mbd.FlexibleBody.beam(
        "bar", line, section, modes=16, position=(0.0, -0.5, 0.0), axes=down, mass="consistent"
    )
    return mbd.System([body], [mbd.Revolute(mbd.Ground().at(), body.at("start"), "z")], gravity=(0.0, -weight, 0.0))


@pytest.mark.thorough
def test_a_pinned_beam_has_its_frequencies():
    """Pinned at one end, free at the other: tan(k L) = tanh(k L), k L = 3.92660, 7.06858 (Blevins, table 8-1)."""
    result = mbd.equilibrium(beam(0.0))
    in_plane = [x**2 * math.sqrt(2.1e11 * 1e-9 / 0.78) / (2 * math.pi) for x in (3.926602, 7.068583)]
    frequencies = result.vibrations[0].frequencies
    assert float(frequencies[0]) == 0.0
    for expected in in_plane:
        assert float((frequencies / expected - 1.0).abs().min()) < 5e-3


@pytest.mark.thorough
def test_a_flexible_pendulum_swings_as_a_rod():
    """The first frequency of a stiff bar: sqrt(3 g / 2 L) / 2 pi."""
    result = mbd.equilibrium(beam(G))
    assert float(result.vibrations[0].frequencies[0]) == pytest.approx(math.sqrt(1.5 * G) / (2 * math.pi), rel=1e-3)


@pytest.mark.thorough
def test_the_motion_from_rest_has_the_frequencies():
    """Independent of the linearization: a small swing of the double pendulum in its first mode comes back in time."""
    shape = mbd.equilibrium(double_pendulum()).vibrations[0].shapes[:, 0]
    a, b = (1e-3 * float(shape[6 + 4 + i] / shape[6 + 4]) for i in range(2))
    period = 1.0 / frequencies_of_the_double_pendulum()[0]
    motion = mbd.simulate(double_pendulum(a, b), period, steps=400).require_ok()
    assert_close(motion.q[0, -1], motion.q[0, 0], rtol=0, atol=5e-7)
    assert float((motion.q[0, 200] - motion.q[0, 0]).abs().max()) > 5e-4


@pytest.mark.parametrize("system", [pendulum, double_pendulum], ids=["flexible", "rigid"])
def test_stiffness_is_the_difference_of_forces(system):
    system = system()
    dynamics = system.dynamics().values()
    T, t = dynamics.topology, torch.zeros((), dtype=torch.float64)
    with torch.no_grad():
        q = dynamics.initial.solve(dynamics)[0][:, 0, 0]
        rest = Linearization.of(dynamics, q, t)
        h = 1e-6
        for k in range(T.n_v):
            ends = []
            for sign in (1.0, -1.0):
                step = torch.zeros(T.n_v, 1, 1, dtype=torch.float64)
                step[k] = sign * h
                at = equations.placement(
                    T, dynamics.data, equations.advance(T, q[:, None, None], step), T.prescribed(t)
                )
                zero = torch.zeros_like(step)
                ends.append(
                    equations.dynamic_residual(T, dynamics.data, at, zero, zero, rest.lam[:, None, None])[:, 0, 0]
                )
            slope = (ends[0] - ends[1]) / (2 * h)
            assert_close(rest.K[:, k], slope, rtol=1e-6, atol=1e-7 * float(rest.K.abs().max()))


@pytest.mark.thorough
def test_damping_is_in_the_poles():
    body = plate("panel", modes=2, damping=1e-4)
    result = mbd.equilibrium(
        mbd.System([body], [mbd.Fixed(mbd.Ground().at(*body.at("center").point.tolist()), body.at("center"))])
    )
    poles, omega = result.vibrations[0].poles, 2 * math.pi * result.vibrations[0].frequencies
    # C = c K: the pole of a mode has the real part -c omega^2 / 2.
    assert_close(
        poles.real.sort().values, (-0.5e-4 * omega.square()).repeat_interleave(2).sort().values, rtol=1e-8, atol=0
    )


@pytest.mark.thorough
@pytest.mark.parametrize("push", [0.5, 1.5, 2.5])
def test_a_force_that_follows_makes_a_column_flutter(push):
    """Ziegler's column: masses 2 and 1 at 1 and 2 m, springs of 1 N m/rad in both joints; flutter from 2.086 N on.

    H. Ziegler, Ing.-Arch. 20 (1952) 49-56. M = [3 1; 1 1], K = [2 - P, P - 1; -1, 1] by the angles of both bars.
    """
    ground, small = mbd.Ground(), (1e-9, 1e-9, 1e-9)
    near, far = (
        mbd.RigidBody(name, m, small, position=(x, 0, 0)) for name, m, x in (("near", 2.0, 1.0), ("far", 1.0, 2.0))
    )
    pairs = [(ground.at(), near.at(-1, 0, 0)), (near.at(), far.at(-1, 0, 0))]
    springs = [mbd.RotationalSpringDamper(a, b, axis="z", stiffness=1.0) for a, b in pairs]
    follower = mbd.Force(far.at(), (-push, 0, 0), axes="frame")
    result = mbd.equilibrium(mbd.System([near, far], [mbd.Revolute(a, b, "z") for a, b in pairs], [*springs, follower]))
    K = np.array([[2.0 - push, push - 1.0], [-1.0, 1.0]])
    squares = np.sort_complex(np.linalg.eigvals(np.linalg.solve([[3.0, 1.0], [1.0, 1.0]], K).astype(complex)))
    poles = np.sqrt(-squares)
    assert_close(
        result.vibrations[0].poles.abs().sort().values, torch.from_numpy(np.abs(poles)).repeat(2).sort().values
    )
    if push < 2.0:
        assert result.vibrations[0].frequencies.tolist() == pytest.approx(
            (np.sqrt(squares.real) / (2 * math.pi)).tolist(), rel=1e-6
        )
    else:
        assert bool(result.vibrations[0].frequencies.isnan().all())
        assert not result.stable
        assert float(result.vibrations[0].poles.real.max()) == pytest.approx(np.abs(poles.real).max(), rel=1e-6)


@pytest.mark.thorough
def test_lanes_have_their_own_equilibrium():
    system = pendulum()
    angles = torch.stack([mbd.deg([20.0, -50.0]), mbd.deg([80.0, 10.0])])
    result = mbd.equilibrium(system, designs={"rod.laminate.angles": angles})
    assert result.q.shape == (2, 1, system.topology.n_q)
    alone = mbd.equilibrium(system, designs={"rod.laminate.angles": angles[1:]})
    assert_close(result.vibrations[1].frequencies, alone.vibrations[0].frequencies, rtol=1e-8, atol=1e-8)
    assert float((result.vibrations[0].frequencies - result.vibrations[1].frequencies).abs().max()) > 1e-3


@pytest.mark.thorough
def test_what_falls_has_no_equilibrium():
    a = box("a")
    system = mbd.System([a], [mbd.Prismatic(mbd.Ground().at(), a.at(), axis="y")], gravity=(0.0, -G, 0.0))
    with refused("system", ANY, "6.87 N or N m", "force y of 'a'"):
        mbd.equilibrium(system)


def test_springs_and_dampers_count():
    """A mass on a guide: the spring is stretched by m g / k, the pole is that of the damped oscillator."""
    m, k, c = 0.7, 300.0, 4.0
    a, ground = box("a"), mbd.Ground()
    spring = mbd.AxialSpringDamper(ground.at(), a.at(), axis="y", stiffness=k, damping=c, rest=-0.1)
    system = mbd.System([a], [mbd.Prismatic(ground.at(), a.at(), axis="y")], [spring], gravity=(0.0, -G, 0.0))
    result = mbd.equilibrium(system)
    assert float(result.q[0, 0, 1]) == pytest.approx(-0.1 - m * G / k, rel=1e-10)
    assert float(result.vibrations[0].frequencies[0]) == pytest.approx(math.sqrt(k / m) / (2 * math.pi), rel=1e-12)
    assert result.vibrations[0].poles.real.tolist() == pytest.approx([-c / (2 * m)] * 2, rel=1e-10)
    assert system.describe().frequencies == pytest.approx(result.vibrations[0].frequencies.tolist())


@pytest.mark.thorough
@pytest.mark.parametrize("stiffness", [1e4, 1e8, 1e10])
def test_a_light_pendulum_beside_a_stiff_mount_comes_to_rest(stiffness):
    """Independent parts: neither the place of rest nor the frequency of one knows the stiffness of the other."""
    ground, m, length = mbd.Ground(), 0.01, 0.1
    bob = mbd.RigidBody("bob", m, (1e-6, 1e-6, 1e-6), position=(length, 0.0, 0.0))
    block = mbd.RigidBody("block", 1.0, (0.1, 0.1, 0.1))
    hinge = mbd.Revolute(ground.at(), bob.at(-length, 0, 0), "z")
    mount = mbd.Bushing(ground.at(), block.at(), stiffness, turning_stiffness=stiffness)
    result = mbd.equilibrium(mbd.System([bob, block], [hinge], [mount], gravity=(0.0, -G, 0.0)))
    assert result.body("bob").r[0, 0].tolist() == pytest.approx([0.0, -length, 0.0], abs=1e-8)
    swing = math.sqrt(m * G * length / (m * length**2 + 1e-6)) / (2 * math.pi)
    assert float(result.vibrations[0].frequencies[0]) == pytest.approx(swing, rel=1e-7)


@pytest.mark.parametrize("pull", [1e3, 1e9])
def test_springs_that_pull_against_each_other_balance(pull):
    """Forces of 1e9 N that cancel leave 1e-7 N of rounding beside a weight of 7 N."""
    m, k, ground, a = 0.7, 1e6, mbd.Ground(), box("a")
    springs = [
        mbd.AxialSpringDamper(ground.at(), a.at(), axis="y", stiffness=k, rest=rest, name=name)
        for name, rest in (("up", pull / k), ("down", -pull / k))
    ]
    system = mbd.System([a], [mbd.Prismatic(ground.at(), a.at(), axis="y")], springs, gravity=(0.0, -G, 0.0))
    result = mbd.equilibrium(system)
    assert float(result.q[0, 0, 1]) == pytest.approx(-m * G / (2 * k), abs=1e-14 * pull)
