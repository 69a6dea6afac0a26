"""The start of mechanisms that only elastic travel lets move: a platform on two leaves, a parallel flexure.

Expected: the rate of the drive; the stiffness 12 D / L^3 of a leaf that is clamped at both ends, as quasi-statics has it.
"""

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
from tests.refused import ANY, refused
from torchmbd.math.pair import cat, value
from torchmbd.multibody.equations import equations

AMPLITUDE, FREQUENCY = 0.004, 2.0
MASS = 0.3
MODES = 8


def flexure(law: Any = None, size: float = 1.0, **options: Any) -> mbd.System:
    """A platform on two leaves; size: factor of all lengths, with masses by its cube."""
    carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    laminate = mbd.Laminate(carbon, mbd.deg([45, -45]), thickness=size * 0.25e-3, symmetric=True)
    mesh = mbd.mesh.rectangle(length=size * 0.1, width=size * 0.02, cells=(4, 2))
    down = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    inertia = tuple(x * size**5 for x in (1e-4, 4e-4, 4e-4))
    platform = mbd.RigidBody("platform", MASS * size**3, inertia, position=(0.04 * size, 0, -0.1 * size), **options)
    ground, joints, leaves = mbd.Ground(), [], []
    for name, x in (("a", 0.0), ("b", 0.08 * size)):
        leaf = mbd.FlexibleBody.plate(name, mesh, laminate, modes=MODES, position=(x, 0, -0.05 * size), axes=down)
        at = platform.at(x - 0.04 * size, 0, 0)
        joints += [mbd.Fixed(ground.at(x, 0, 0), leaf.at("left")), mbd.Fixed(leaf.at("right"), at)]
        leaves.append(leaf)
    if law is not None:
        at = ground.at(0.04 * size, 0, -0.1 * size)
        joints.append(mbd.Drive(at, platform, axis="x", name="shaker", position=law))
    return mbd.System([*leaves, platform], joints)


def start(system: mbd.System) -> tuple[Tensor, float]:
    """Velocity of the platform [3], and the largest constraint rate that is open."""
    d = system.dynamics()
    T, t = d.topology, torch.zeros((), dtype=torch.float64)
    with torch.no_grad():
        q, v = d.initial.solve(d)
        at = equations.placement(T, d.data, q, T.prescribed(t))
        rates = equations.constraint_jets(T, at, d.data, v, torch.zeros_like(v), t).velocity
    i = T.names.index("platform")
    return v[: 3 * T.bodies, 0, 0].reshape(3, -1)[:, i], float(rates.abs().max())


@pytest.mark.thorough
@pytest.mark.parametrize("size", [1.0, 1e-3, 30.0])
def test_a_driven_flexure_starts_with_the_rate_of_its_drive(size):
    velocity, rest = start(flexure(mbd.Sine(AMPLITUDE * size, FREQUENCY), size))
    speed = 2.0 * math.pi * FREQUENCY * AMPLITUDE * size
    assert_close(velocity, tensor(speed, 0.0, 0.0), rtol=0, atol=1e-11 * speed)
    assert rest < 1e-11 * speed


@pytest.mark.thorough
def test_a_given_velocity_that_the_drive_has_too_is_kept():
    speed = 2.0 * math.pi * FREQUENCY * AMPLITUDE
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        velocity, rest = start(flexure(mbd.Sine(AMPLITUDE, FREQUENCY), velocity=(speed, 0.0, 0.0)))
    assert_close(velocity, tensor(speed, 0.0, 0.0), rtol=0, atol=1e-11 * speed)
    assert rest < 1e-11 * speed


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:the joints do not allow")
@pytest.mark.parametrize("given", [{}, {"velocity": (0.05, 0.01, 0.0)}])
def test_the_start_of_leaves_has_derivatives_by_the_design(given):
    """Kinetic energy and rigid rates, which do not depend on the basis of the modes, forward, reverse and by differences."""
    system, name = flexure(mbd.Sine(AMPLITUDE, FREQUENCY), **given), "a.laminate.angles"

    def functional(d: Any) -> Any:
        T = d.topology
        q, v = d.initial.solve(d)
        at = equations.placement(T, d.data, q, T.prescribed(torch.zeros((), dtype=torch.float64), d.data))
        momenta = cat([x.flatten(0, 1) for x in equations.inertia_forces(T, d.data, at, 0.0 * v, v)])
        return (momenta * v).sum(0) + v[: 6 * T.bodies].sum(0)

    x, h = system.get_parameter(name).detach(), 1e-5
    steps = h * torch.eye(len(x)).double()
    moved = functional(system.dynamics({name: torch.cat([x + steps, x - steps])}))[0]
    slopes = (moved[: len(x)] - moved[len(x) :]) / (2.0 * h)
    forward = functional(system.dynamics({name: x[None]}, (name,)))
    (reverse,) = torch.autograd.grad(functional(system().dynamics).sum(), system.get_parameter(name))
    assert float(slopes.abs().max()) > 0.01 * float(value(forward).abs().max())
    assert_close(forward.tangent[:, 0], slopes, rtol=1e-6, atol=1e-7)
    assert_close(reverse, forward.tangent[:, 0], rtol=1e-8, atol=1e-9)


@pytest.mark.thorough
def test_the_force_of_the_drive_begins_as_quasi_statics_has_it():
    """No ringing: the force is the elastic one less that of the platform's acceleration, within a part in fifty."""
    motion = mbd.simulate(flexure(mbd.Sine(AMPLITUDE, FREQUENCY)), 0.5, steps=200).require_ok()
    x = mbd.Position("platform", "x")(motion)[0] - 0.04
    assert float(mbd.Max(mbd.Position("platform", "x"))(motion)) - 0.04 == pytest.approx(AMPLITUDE, rel=1e-4)
    force = motion.reaction("shaker").force[0, :, 0]
    late = slice(150, None)
    stiffness = float((force[late] * x[late]).sum() / (x[late] ** 2).sum())  # of the steady motion, signed
    assert_close(force, stiffness * x, rtol=0, atol=0.02 * float(force[late].abs().max()))


@pytest.mark.thorough
def test_a_flexure_that_starts_displaced_is_refused_or_bent_to_equilibrium():
    def law(t: Tensor) -> Tensor:
        return AMPLITUDE * torch.cos(2.0 * math.pi * FREQUENCY * t)

    with refused("joints", ANY, "start='equilibrium'"):
        start(flexure(law))
    motion = mbd.simulate(flexure(law), 0.01, steps=4, start="equilibrium").require_ok()
    assert float(mbd.Position("platform", "x")(motion)[0, 0]) - 0.04 == pytest.approx(AMPLITUDE, rel=1e-9)


@pytest.mark.thorough
def test_describe_has_the_elastic_freedom_of_a_driven_flexure():
    free, driven = flexure().describe(), flexure(mbd.Sine(AMPLITUDE, FREQUENCY)).describe()
    assert driven.rank == free.rank + 1
    assert driven.freedoms == free.freedoms - 1
    assert driven.mobility == free.mobility == 0
