"""Steady rotation of systems: pendulums in closed form, blades as alone and as published, derivatives, refusals."""

from __future__ import annotations

import cmath
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.exact_beam.cases import given, matrix
from tests.fem.exact_beam.test_vibrations import INCH, blade
from tests.refused import ANY, refused, warned
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import SteadyRotation

GROUND = mbd.Ground()
SPEED = 5.0


def hub(speed: float) -> tuple[mbd.RigidBody, list[mbd.joints.Joint]]:
    body = mbd.RigidBody("hub", 1.0, (1e-3, 1e-3, 1e-3))
    hinge = mbd.Revolute(GROUND.at(), body.at(), axis="z", name="hinge")
    return body, [hinge, mbd.Drive(GROUND.at(), body.at(), axis="z", speed=speed, name="motor")]


@pytest.mark.thorough
@pytest.mark.parametrize(("axis", "more"), [("z", 0.0), ("y", 1.0)])
def test_hinged_blade(axis, more):
    """Of mass m, its center s from a hinge at e: lagging and flapping, w^2 = speed^2 (more + m e s / I)."""
    m, s, e, inertia = 2.0, 0.5, 0.2, 0.1
    own, joints = hub(SPEED)
    bar = mbd.RigidBody("bar", m, (1e-9, inertia, inertia), position=(e + s, 0.0, 0.0))
    joints.append(mbd.Revolute(own.at(e, 0, 0), bar.at(-s, 0, 0), axis=axis, name="root"))
    rest = mbd.equilibrium(mbd.System([own, bar], joints), spin=(0.0, 0.0, SPEED))
    expected = SPEED * math.sqrt(more + m * e * s / (inertia + m * s**2)) / (2.0 * math.pi)
    assert rest.vibrations[0].frequencies.tolist() == [pytest.approx(expected, rel=1e-8)]
    assert_close(rest.body("bar").at().velocity[0, 0], torch.tensor([0.0, SPEED * (e + s), 0.0], dtype=torch.float64))
    pull = rest.reaction("root").force[0, 0].norm()
    assert pull.item() == pytest.approx(m * SPEED**2 * (e + s), rel=1e-9)


def test_mass_on_springs_seen_by_a_turning_observer():
    """w + speed and w - speed in the plane, w along the axis."""
    mass, w = mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0)), 12.0
    hold = mbd.Bushing(GROUND.at(), mass.at(), (2.0 * w**2,) * 3, name="hold")
    spin = SteadyRotation.of((0.0, 0.0, SPEED), (0.0, 0.0, 0.0))
    dynamics = mbd.System([mass], forces=[hold]).dynamics()
    q, _ = dynamics.initial.solve(dynamics)
    rest = Linearization.of(dynamics, q[:, 0, 0], torch.zeros((), dtype=torch.float64), observer=spin)
    own = [0, 1, 2]
    M, C, K = (x[own][:, own] for x in (rest.M, rest.C, rest.K))
    one, nothing = torch.eye(3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    A = torch.cat([torch.cat([nothing, one], 1), torch.cat([-torch.linalg.solve(M, x) for x in (K, C)], 1)])
    assert torch.linalg.eigvals(A).imag.sort().values[3:].tolist() == pytest.approx([w - SPEED, w, w + SPEED])


@pytest.mark.thorough
@pytest.mark.parametrize("speed", [5.0, 15.0])
@pytest.mark.parametrize("damping", [0.0, 2.0, 50.0])
def test_poles_of_a_mass_that_the_ground_holds(speed, damping):
    """m s^2 + c s + k = 0 seen from the turning frame: s +- i speed, stable below and above the critical speed 12."""
    mass, k = mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0)), 2.0 * 12.0**2
    hold = mbd.Bushing(GROUND.at(), mass.at(), (k,) * 3, (damping,) * 3, name="hold")
    rest = mbd.equilibrium(mbd.System([mass], forces=[hold]), spin=(0.0, 0.0, speed))
    assert bool(rest.vibrations[0].frequencies.isfinite().all())
    poles = rest.vibrations[0].poles
    root = cmath.sqrt(damping**2 - 8.0 * k)
    for s in ((-damping + root) / 4.0, (-damping - root) / 4.0):
        for expected in (s, s + 1j * speed, s - 1j * speed):
            assert float((poles - expected).abs().min()) < 1e-6


@pytest.mark.thorough
def test_a_blade_inside_its_hinge_is_driven_away():
    own, joints = hub(SPEED)
    bar = mbd.RigidBody("bar", 2.0, (1e-9, 0.1, 0.1), position=(0.3, 0.0, 0.0))
    joints.append(mbd.Revolute(own.at(0.5, 0, 0), bar.at(0.2, 0, 0), axis="z", name="root"))
    assert bool(
        mbd.equilibrium(mbd.System([own, bar], joints), spin=(0.0, 0.0, SPEED)).vibrations[0].frequencies.isnan().all()
    )


def rotor(beam: mbd.FlexibleBeam, speed: float, offset: float = 0.0, **options: Any) -> mbd.System:
    """A blade on a hub that a motor turns."""
    own, joints = hub(speed)
    joints.append(mbd.Fixed(own.at(offset, 0, 0), beam.at("start"), name="root"))
    return mbd.System([own, beam], joints, **options)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("sweep", "rpm", "wanted"),
    [
        (0.0, 500.0, [10.2, 25.2, 47.0]),
        (0.0, 750.0, [14.8, 36.1, 62.9]),
        (math.pi / 4.0, 750.0, [14.7, 26.1, 44.8]),
    ],
)
def test_blades_of_epps_and_chandra(sweep, rpm, wanted):
    """Measured (tests/fem/exact_beam/test_vibrations.py); masses at nodes otherwise than those of the beam alone."""
    alone, center = blade(sweep)
    speed, offset = rpm * math.pi / 30.0, 2.5 * INCH
    beam = mbd.FlexibleBeam("blade", alone.mesh, alone.section, position=(offset, 0.0, 0.0))
    result = mbd.equilibrium(rotor(beam, speed, offset), spin=(0.0, 0.0, speed)).vibrations[0].frequencies[:6]
    for frequency in wanted:
        assert float(((result - frequency) / frequency).abs().min()) < 0.1, result.tolist()
    assert_close(result[:5], alone.frequencies(5, spin=(0.0, 0.0, speed), center=center)[0], rtol=2.5e-2, atol=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize(("speed", "wanted"), [(4.0, [5.5850, 24.2734]), (12.0, [13.1702, 37.6031])])
def test_flapping_of_a_rotating_cantilever(speed, wanted):
    """A. D. Wright et al., J. Appl. Mech. 49 (1982), in sqrt(E I / (m L^4)); lagging: w^2 - speed^2. Second order."""
    errors = []
    for elements in (8, 16):
        section = given(1e6, 1e6, 1e6, 1e3, 1.0, 1.0, mass=matrix(1.0, 1.0, 1.0, 2e-8, 1e-8, 1e-8))
        beam = mbd.FlexibleBeam("rotor", mbd.BeamLine.straight(1.0, elements), section)
        w = 2.0 * math.pi * mbd.equilibrium(rotor(beam, speed), spin=(0.0, 0.0, speed)).vibrations[0].frequencies[:4]
        lag = math.sqrt(wanted[0] ** 2 - speed**2)
        errors.append([float((w / x - 1.0).abs().min()) for x in (*wanted, lag)])
    assert max(errors[1]) < 7e-3
    assert errors[0][0] / errors[1][0] == pytest.approx(4.0, rel=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("stiffening", [True, False])
def test_a_floating_frame_needs_stiffening(stiffening):
    """The same blade with small displacements: within half a percent; without stiffening a warning says what is missing."""
    section = given(1e6, 1e6, 1e6, 1e3, 1.0, 1.0, mass=matrix(1.0, 1.0, 1.0, 2e-8, 1e-8, 1e-8))
    own, joints = hub(12.0)
    line = mbd.BeamLine.straight(1.0, 8)
    blade = mbd.FlexibleBody.beam("rotor", line, section, modes=12, reference="start", stiffening=stiffening)
    joints.append(mbd.Fixed(own.at(), blade.at("start"), name="root"))
    system = mbd.System([own, blade], joints, truncation=None)
    if stiffening:
        w = 2.0 * math.pi * mbd.equilibrium(system, spin=(0.0, 0.0, 12.0)).vibrations[0].frequencies[:2]
        assert w.tolist() == pytest.approx([math.sqrt(13.1702**2 - 12.0**2), 13.1702], rel=5e-3)
    else:
        with warned("body 'rotor'", "centrifugal stiffening"):
            mbd.equilibrium(system, spin=(0.0, 0.0, 12.0))


def bent(K: Tensor | None = None) -> tuple[mbd.System, float]:
    """A soft blade with a bent tip, which gravity along the axis bends down."""
    leg = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.8, 0.0, 0.0], [1.0, 0.2, 0.0]], dtype=torch.float64)
    section = mbd.GivenSection(
        torch.diag(torch.tensor([1e4, 1e4, 1e4, 3.0, 2.0, 4.0])).double() if K is None else K, MASS
    )
    section.matrix.requires_grad_(True)
    return rotor(mbd.FlexibleBeam("blade", mbd.BeamLine(leg), section), SPEED, gravity=(0.0, 0.0, -9.81)), SPEED


MASS = matrix(0.1, 0.1, 0.1, 2e-5, 1e-5, 1e-5)


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled")
def test_a_motion_that_starts_there_stays():
    system, speed = bent()
    rest = mbd.equilibrium(system, spin=(0.0, 0.0, speed))
    assert float(rest.body("blade").displacements[0, 0, -1, 2]) < -0.01
    motion = mbd.simulate(system, 0.5, steps=200, start=rest, gradients="none")
    assert motion.status == ["ok"]
    tip = motion.body("blade").displacements[0, :, -1]
    assert_close(tip, tip[:1].expand_as(tip), atol=1e-5, rtol=0.0)


@pytest.mark.thorough
def test_derivatives():
    """Of the place, velocity and root moment, by the stiffness: forward, reverse and differences."""
    system, speed = bent()
    K = system.body("blade").section.matrix.detach()

    def response(x: Tensor) -> Tensor:
        rest = mbd.equilibrium(system, designs={"blade.section.matrix": x[None]}, spin=(0.0, 0.0, speed))
        return (
            rest.body("blade").nodes[0, 0, -1, 2]
            + 0.1 * rest.body("blade").at("end").velocity[0, 0, 1]
            + rest.reaction("root").torque[0, 0, 0]
        )

    way = torch.diag(torch.tensor([0.0, 0.0, 0.0, 1.0, 0.5, 2.0], dtype=torch.float64))
    with torch.no_grad():
        one, two = (float(response(K + h * way) - response(K - h * way)) / (2.0 * h) for h in (0.01, 0.02))
    leaf = K.clone().requires_grad_()
    (by,) = torch.autograd.grad(response(leaf), leaf)
    reverse = float((by * way).sum())
    forward = float(torch.func.jvp(response, (K,), (way,))[1])
    assert reverse == pytest.approx((4.0 * one - two) / 3.0, rel=1e-6)
    assert forward == pytest.approx(reverse, rel=1e-8)


@pytest.mark.thorough
def test_refusals():
    system, speed = bent()
    for spin in ((0.0, 0.0, 0.5 * speed), (0.0, speed, 0.0)):  # the motor turns faster; gravity lies across
        with refused("system"):
            mbd.equilibrium(system, spin=spin)
    with refused("spin", (0.0, 1.0)):
        mbd.equilibrium(system, spin=(0.0, 1.0))
    with refused("center", (1.0, 0.0, 0.0)):
        mbd.equilibrium(system, center=(1.0, 0.0, 0.0))


def test_a_spring_beside_the_axis_is_no_steady_rotation():
    """Its force loads the joints only, and another way after a turn; what is free to move feels nothing of it."""
    own, joints = hub(SPEED)
    bar = mbd.RigidBody("bar", 2.0, (0.1, 0.1, 0.1), position=(0.3, 0.0, 0.0))
    joints.append(mbd.Revolute(own.at(), bar.at(-0.3, 0, 0), axis="y", name="root"))
    hold = mbd.Bushing(GROUND.at(0.3, 0, 0), bar.at(), (10.0, 10.0, 10.0), name="hold")
    with refused("system", ANY, "after a turn"):
        mbd.equilibrium(mbd.System([own, bar], joints, forces=[hold]), spin=(0.0, 0.0, SPEED))


def turning_mass(*forces: Any, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> mbd.System:
    """A rotor about x: forces are functions of its body."""
    rotor = mbd.RigidBody("rotor", 1.0, (0.02, 0.01, 0.01), position=at)
    return mbd.System([rotor], [], [force(rotor) for force in forces], free=["rotor"])


def bearing(along: Any = 1e6, damping: Any = 0.0, tilt: Any = (0.0, 1e4, 1e4), x: float = 0.0) -> Any:
    return lambda rotor: mbd.Bushing(GROUND.at(x, 0, 0), rotor.at(x, 0, 0), along, damping, tilt, name=f"bearing_{x:g}")


def spring(axis: str, stiffness: float, x: float = 0.0) -> Any:
    return lambda rotor: mbd.AxialSpringDamper(
        GROUND.at(x, 0, 0), rotor.at(x, 0, 0), axis=axis, stiffness=stiffness, name=f"spring_{axis}_{x:g}"
    )


SPIN = (300.0, 0.0, 0.0)


@pytest.mark.thorough
def test_bearings_alike_across_the_axis():
    """Whirling at 1000 rad/s is seen at 1000 -+ 300; tilting k / I = 1e6 with the gyroscopic moment of J = 2 I as well:
    I w^2 -+ J 300 w - k = 0 in the ground, a round rotor, seen at w -+ 300."""
    rest = mbd.equilibrium(turning_mass(bearing()), spin=SPIN, unstable=True)
    tilt = [math.sqrt(300.0**2 + 1e6) + sign * 300.0 for sign in (-1.0, 1.0)]  # in the ground
    seen = [tilt[0] + 300.0, tilt[1] - 300.0]
    expected = sorted([0.0, 700.0, 1000.0, 1300.0, *seen])
    assert (2.0 * math.pi * rest.vibrations[0].frequencies).tolist() == pytest.approx(expected, rel=1e-9, abs=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("forces", "named"),
    [
        ([bearing((1e6, 1e6, 0.5e6))], "the stiffness against displacement [yz] of 'rotor'"),
        ([bearing((1e6, 1e6, 1.001e6))], "the stiffness against displacement [yz] of 'rotor'"),
        ([bearing(tilt=(0.0, 1e4, 2e4))], "the stiffness against rotation [yz] of 'rotor'"),
        ([bearing(damping=(0.0, 3.0, 5.0))], "the damping against displacement [yz] of 'rotor'"),
        (
            [bearing(x=-0.2), bearing((1e6, 1e6, 2e6), x=0.2)],
            "the stiffness against (rotation|displacement) [yz] of 'rotor'",
        ),
        ([spring("x", 1e6), spring("y", 1e10, 0.1), spring("z", 1e10, 0.1), spring("y", 9.0)], "the stiffness"),
        (
            [bearing(), lambda rotor: mbd.PlaneContact(GROUND.at(), rotor.at(), radius=0.06)],
            "joints or forces are others",
        ),
    ],
)
def test_supports_of_two_stiffnesses_are_no_steady_rotation(forces, named):
    with pytest.raises(mbd.InputError, match=f"no steady rotation: {named}"):
        mbd.equilibrium(turning_mass(*forces), spin=SPIN, unstable=True)


@pytest.mark.thorough
def test_two_springs_that_are_alike_turn_steadily():
    """Tilting is free: nutation at J / I 300 = 600 rad/s in the ground, seen at 300 as is what stands still."""
    rest = mbd.equilibrium(turning_mass(*(spring(axis, 1e6) for axis in "xyz")), spin=SPIN, unstable=True)
    expected = [0.0, 300.0, 300.0, 700.0, 1000.0, 1300.0]
    assert (2.0 * math.pi * rest.vibrations[0].frequencies).tolist() == pytest.approx(expected, abs=1e-4)


def test_a_point_that_meets_a_plane_at_some_angle_is_no_steady_rotation():
    """Out of reach at the start and after a turn by 1 rad, but not all around."""
    tip = turning_mass(
        bearing(tilt=0.0),
        lambda rotor: mbd.PlaneContact(GROUND.at(0, 0, -0.09), rotor.at(0, 0, 0.1), stiffness=1e3),
    )
    with refused("system", ANY, "3 rad"):
        mbd.equilibrium(tip, spin=SPIN, unstable=True)
