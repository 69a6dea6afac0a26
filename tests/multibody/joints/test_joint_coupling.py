"""Couplings of joints against closed forms: reflected inertias, many turns, reactions, gradients by ratio and offset."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import finished, tensor, turned
from tests.refused import refused
from torchmbd.errors import InputError

FIRST, SECOND, TORQUE, RATIO = 0.02, 0.05, 3.0, 2.5  # inertias [kg m2], torque [N m], factor of the first angle
ABOUT_Z = (0.03, 0.03)


def gear(ratio=RATIO, offset=0.0, drive=None, extra=()) -> mbd.System:
    """Two wheels on the ground with ratio angle_1 + angle_2 = offset, and a torque on the first one."""
    ground = mbd.Ground()
    first = mbd.RigidBody("first", 1.0, (*ABOUT_Z, FIRST))
    second = mbd.RigidBody("second", 2.0, (*ABOUT_Z, SECOND), position=(0.3, 0, 0))
    hinges = [
        mbd.Revolute(ground.at(), first.at(), name="one"),
        mbd.Revolute(ground.at(0.3, 0, 0), second.at(), name="two"),
    ]
    coupling = mbd.JointCoupling([hinges[0].angle, hinges[1].angle], [ratio, 1.0], offset, name="gear")
    motors = [] if drive is None else [mbd.Drive(ground.at(), first.at(), speed=drive, name="motor")]
    forces = [mbd.Torque(first.at(), (0, 0, TORQUE), name="push")] if drive is None else []
    return mbd.System([first, second], [*hinges, coupling, *motors, *extra], forces)


def simulated(system: mbd.System, duration: float, method: str = "generalized_alpha", steps: int = 40, **options):
    return finished(mbd.simulate(system, duration, method, steps, **{"backend": "eager"} | options))


def unwrapped(A: Tensor) -> np.ndarray:
    """Angle about z of rotation matrices [times, 3, 3], continuous in time."""
    return np.unwrap(np.arctan2(A[:, 1, 0].numpy(), A[:, 0, 0].numpy()))


def angles(motion: mbd.Trajectory, *bodies: str) -> list[np.ndarray]:
    return [unwrapped(motion.body(name).A[0].detach()) for name in bodies]


ACCELERATION = TORQUE / (FIRST + RATIO**2 * SECOND)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "hht_alpha"])
def test_a_gear_reflects_inertia_by_its_ratio_over_many_turns(method):
    motion = simulated(gear(), 1.6, method, 60)
    first, second = angles(motion, "first", "second")
    assert abs(second[-1]) > 4.5 * 2 * math.pi
    np.testing.assert_allclose(first, 0.5 * ACCELERATION * motion.t.numpy() ** 2, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(second, -RATIO * first, rtol=0, atol=1e-10)


@pytest.mark.thorough
def test_torques_on_both_sides():
    motion = simulated(gear(), 0.5, steps=10)
    on = {name: mbd.Reaction("gear", "z", "torque", on=name)(motion)[0] for name in ("first", "second")}
    torch.testing.assert_close(
        on["second"], torch.full_like(on["second"], -RATIO * ACCELERATION * SECOND), rtol=1e-10, atol=0
    )
    torch.testing.assert_close(on["first"], RATIO * on["second"], rtol=1e-12, atol=0)
    torch.testing.assert_close(motion.reaction("gear").torque[0, :, 2], on["first"], rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    "ground", [mbd.Ground().at, lambda *at: mbd.Ground().at(*at)], ids=["one Ground", "a Ground each"]
)
def test_loads_of_a_coupling_are_in_equilibrium(ground):
    """About one point, over all its bodies; the ground counts once, however often it is written."""
    a = mbd.RigidBody("a", 2.0, (0.03, 0.03, 0.05))
    b = mbd.RigidBody("b", 1.0, (0.03, 0.03, 0.05), position=(1.0, 0.0, 0.0))
    joints: list = [
        mbd.Revolute(ground(), a.at(), name="one"),
        mbd.Revolute(ground(1.0, 0.0, 0.0), b.at(), name="two"),
    ]
    factor = mbd.variable(0.2)
    gear = mbd.JointCoupling([joint.angle for joint in joints], [0.1, factor], name="gear")
    motion = simulated(mbd.System([a, b], [*joints, gear], [mbd.Torque(a.at(), (0.0, 0.0, 1.0))]), 0.1, steps=5)
    a_, b_, g = (mbd.Reaction("gear", "z", "torque", on=on)(motion)[0, -1] for on in ("a", "b", "ground"))
    torch.testing.assert_close(b_, 2.0 * a_, rtol=1e-12, atol=0)
    torch.testing.assert_close(g, -a_ - b_, rtol=1e-12, atol=0)
    slopes = [torch.autograd.grad(x, factor, retain_graph=True)[0] for x in (a_, b_, g)]
    torch.testing.assert_close(sum(slopes), torch.zeros_like(slopes[0]), rtol=0, atol=1e-10)


@pytest.mark.thorough
def test_methods_of_ordinary_differential_equations():
    motion = simulated(gear(), 0.7, "rk4", 70)
    first, second = angles(motion, "first", "second")
    assert second[-1] < -1.7 * math.pi
    assert first[-1] == pytest.approx(0.245 * ACCELERATION, rel=1e-3)
    np.testing.assert_allclose(second, -RATIO * first, rtol=0, atol=2e-2)


#: An offset opens the joints at the given positions: the start closes them, and says so.
CLOSED = pytest.mark.filterwarnings("ignore:joints are open")


def by_ratio_and_offset() -> mbd.System:
    return gear(mbd.variable(RATIO), mbd.variable(0.4))


@pytest.mark.thorough
@CLOSED
def test_gradients_by_ratio_and_offset():
    """The final angle of the first wheel, from where the closed joints are: the nearest to the given positions."""
    system = by_ratio_and_offset()
    assert [name for name, _ in system.named_parameters()] == ["gear.factor1", "gear.offset"]
    duration, values, slopes = 0.5, [], []
    for way in ("forward", "reverse"):
        motion = simulated(system, duration, steps=8, gradients=way, iterations=(5, 5))
        A = motion.body("first").A[0, -1]
        angle = torch.atan2(A[1, 0], A[0, 0])
        values.append(float(angle.detach()))
        slopes.append(torch.stack(torch.autograd.grad(angle, list(system.parameters()))))
    r, d, J = RATIO, 0.4, FIRST + RATIO**2 * SECOND
    assert values[0] == pytest.approx(d * r / (r * r + 1) + 0.5 * ACCELERATION * duration**2, rel=1e-10)
    by_ratio = d * (1 - r * r) / (r * r + 1) ** 2 - TORQUE * 2 * r * SECOND / J**2 * 0.5 * duration**2
    torch.testing.assert_close(slopes[0], tensor(by_ratio, r / (r * r + 1)), rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=0, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.extensions
@CLOSED
def test_compiled_steps():
    """As operators of torch: angles of many turns, both gradients, and the right-hand side of index 1."""
    system = by_ratio_and_offset()
    for method, duration, ways in (("generalized_alpha", 1.0, ("forward", "reverse")), ("rk4", 0.4, ("forward",))):
        expected = simulated(system, duration, method, 40)
        for way in ways:
            motion = simulated(system, duration, method, 40, backend="native", gradients=way)
            assert motion.stats["backend"] == "native"
            torch.testing.assert_close(motion.q.detach(), expected.q.detach(), rtol=0, atol=1e-9)
            slopes = [
                torch.stack(
                    torch.autograd.grad(x.q[0, -1].square().sum(), list(system.parameters()), retain_graph=True)
                )
                for x in (motion, expected)
            ]
            torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-8, atol=1e-8)


@pytest.mark.thorough
def test_a_driven_wheel_turns_the_other_one():
    """The joints to the ground leave the driven wheel no freedom; its turns are counted nevertheless."""
    motion = simulated(gear(drive=9.0), 1.0, steps=30)
    first, second = angles(motion, "first", "second")
    np.testing.assert_allclose(first, 9.0 * motion.t.numpy(), rtol=0, atol=1e-10)
    np.testing.assert_allclose(second, -RATIO * 9.0 * motion.t.numpy(), rtol=0, atol=1e-10)


@pytest.mark.thorough
def test_a_motion_that_continues_another_knows_its_turns():
    system = gear()
    middle = simulated(system, 0.8, steps=20)
    after = simulated(system, 0.4, steps=14, start=middle)
    assert angles(middle, "second")[0][-1] < -2 * math.pi
    for name, factor in (("first", 1.0), ("second", -RATIO)):
        turn = float(torch.from_numpy(angles(after, name)[0])[-1]) - factor * 0.5 * ACCELERATION * 1.2**2
        assert math.remainder(turn, 2 * math.pi) == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize("backend", ["eager", "native"])
def test_a_clutch_opens(backend):
    """Released in a second phase: the first wheel gets its torque alone, the second keeps its speed."""
    phases = [mbd.Phase(until=0.8), mbd.Phase(release=["gear"])]
    ratio = mbd.variable(RATIO)
    motion = simulated(gear(ratio), 0.9, steps=36, phases=phases, backend=backend)
    slope = ACCELERATION * (1.0 - 2.0 * RATIO**2 * SECOND / (FIRST + RATIO**2 * SECOND))  # of RATIO x ACCELERATION
    motion.body("second").omega[0, -1, 2].backward()
    assert float(ratio.grad) == pytest.approx(-slope * 0.8, rel=1e-8)
    spins = [motion.body(name).omega[0, -1, 2].item() for name in ("first", "second")]
    assert spins[1] == pytest.approx(-RATIO * ACCELERATION * 0.8, rel=1e-10)
    assert spins[0] == pytest.approx(ACCELERATION * 0.8 + TORQUE / FIRST * 0.1, rel=1e-10)


def test_frequency_of_a_geared_torsion_pendulum():
    system, stiffness = gear(), 40.0
    spring = mbd.RotationalSpringDamper(mbd.Ground().at(), system.body("second").at(), "z", stiffness=stiffness)
    system = mbd.System(system.bodies, system.joints, [spring])
    expected = math.sqrt(RATIO**2 * stiffness / (FIRST + RATIO**2 * SECOND)) / (2 * math.pi)
    assert system.describe().frequencies == pytest.approx([expected], rel=1e-10)


@pytest.mark.parametrize("turned", [False, True])
def test_the_planet_of_the_page_and_a_pin_with_its_frames_in_the_other_order(turned):
    """s (w_sun - w_carrier) + p (w_planet - w_carrier) = 0; the angle of a pin from planet to carrier has the other sign."""
    s, p, speeds = 0.06, 0.03, {"sun": 0.5, "carrier": 1.2}
    ground, frames = mbd.Ground(), mbd.Ground().at()
    sun, carrier = (mbd.RigidBody(name, 1.0, (*ABOUT_Z, FIRST)) for name in speeds)
    planet = mbd.RigidBody("planet", 0.5, (*ABOUT_Z, FIRST), position=(s + p, 0, 0))
    hinges = [mbd.Revolute(frames, x.at(), name=f"of_{x.name}") for x in (sun, carrier)]
    ends = carrier.at(s + p, 0, 0), planet.at()
    pin = mbd.Revolute(*(ends[::-1] if turned else ends), name="pin")
    factor = -p if turned else p
    mesh = mbd.JointCoupling([hinges[0].angle, hinges[1].angle, pin.angle], [s, -s, factor])
    drives = [mbd.Drive(ground, x, axis="z", speed=speeds[x.name]) for x in (sun, carrier)]
    motion = simulated(mbd.System([sun, carrier, planet], [*hinges, pin, mesh, *drives]), 0.2, steps=4)
    expected = speeds["carrier"] - s * (speeds["sun"] - speeds["carrier"]) / p
    assert motion.body("planet").omega[0, -1, 2].item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.thorough
def test_planetary_gear():
    """Sun, planet, carrier and a fixed ring, turned in space; the inertia that a torque on the sun accelerates."""
    sun_radius, planet_radius = 0.04, 0.03
    ring_radius, arm = sun_radius + 2 * planet_radius, sun_radius + planet_radius
    J = {"sun": 2e-3, "carrier": 5e-3, "planet": 4e-4}
    mass, torque, A = 0.8, 0.1, turned(0.4, -0.9, 1.3)
    ground = mbd.Ground()
    sun, carrier, planet = (
        mbd.RigidBody(name, mass, (0.7 * x, 0.6 * x, x), position=A @ tensor(arm * (name == "planet"), 0, 0), axes=A)
        for name, x in J.items()
    )
    base = ground.at(axes=A)
    hinges = [
        mbd.Revolute(base, sun.at(), name="sun_hinge"),
        mbd.Revolute(base, carrier.at(), name="carrier_hinge"),
        mbd.Revolute(carrier.at(arm, 0, 0), planet.at(), name="planet_pin"),
    ]
    of_sun, of_carrier, of_planet = (hinge.angle for hinge in hinges)
    meshes = [
        mbd.JointCoupling([of_sun, of_carrier, of_planet], [sun_radius, -sun_radius, planet_radius], name="inner"),
        mbd.JointCoupling([of_carrier, of_planet], [ring_radius, planet_radius], name="outer"),
    ]
    push = mbd.Torque(sun.at(), (0, 0, torque), axes="frame")
    system = mbd.System([sun, carrier, planet], [*hinges, *meshes], [push])
    assert (system.describe().freedoms, system.describe().redundant) == (1, ())
    n = 1 + ring_radius / sun_radius
    spin = 1 - ring_radius / planet_radius
    inertia = J["sun"] + (J["carrier"] + mass * arm**2 + spin**2 * J["planet"]) / n**2
    motion = simulated(system, 0.6, steps=20)
    sun_angle, *others = (unwrapped(A.mT @ motion.body(name).A[0]) for name in J)
    assert sun_angle[-1] > math.pi
    for name, other, ratio in zip(J, (sun_angle, *others), (1.0, 1 / n, spin / n), strict=True):
        assert float(motion.body(name).omega_rate[0, 0, 2]) == pytest.approx(ratio * torque / inertia, rel=1e-10)
        np.testing.assert_allclose(other, ratio * sun_angle, rtol=0, atol=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("parts", [1, 2])
def test_ball_screw(parts):
    """A screw and a nut of their own, or a body that turns as it travels: inertia and mass reflected by the lead."""
    lead, torque, J, mass, load = 0.01, 0.2, 3e-3, 6.0, 4.0
    ground, screw = mbd.Ground(), mbd.RigidBody("screw", mass, (2e-3, 2e-3, J))
    factors, push = [lead / (2 * math.pi), -1.0], mbd.Torque(screw.at(), (0, 0, torque))
    if parts == 1:
        guide = mbd.Cylindrical(ground.at(), screw.at(), axis="z")
        nut, bodies, joints, coordinates = screw, [screw], [guide], [guide.angle, guide.travel]
    else:
        nut = mbd.RigidBody("nut", mass, (1e-3, 1e-3, 1e-3))
        hinge, slide = mbd.Revolute(ground.at(), screw.at()), mbd.Prismatic(ground.at(), nut.at(), axis="z")
        bodies, joints, coordinates = [screw, nut], [hinge, slide], [hinge.angle, slide.travel]
    pull = mbd.Force(nut.at(), (0, 0, -load))
    coupling = mbd.JointCoupling(coordinates, factors, name="thread")
    motion = simulated(mbd.System(bodies, [*joints, coupling], [push, pull]), 0.5, steps=25)
    c = lead / (2 * math.pi)
    acceleration = (torque - c * load) / (J + c * c * mass)
    expected = 0.5 * c * acceleration * motion.t**2
    torch.testing.assert_close(motion.body(nut.name).r[0, :, 2], expected, rtol=1e-10, atol=1e-12)
    assert float(motion.body("screw").omega[0, -1, 2]) == pytest.approx(0.5 * acceleration, rel=1e-10)
    if parts == 2:
        thrust = mbd.Reaction("thread", "z", "force", on="nut")(motion)[0]
        torch.testing.assert_close(thrust, torch.full_like(thrust, mass * c * acceleration + load), rtol=1e-9, atol=0)


@pytest.mark.thorough
def test_differential():
    """Two axle shafts and a cage; torques on the cage and against one shaft. Solved as a linear system of three angles."""
    J, torques = np.array([0.02, 0.03, 0.05]), np.array([-0.4, 0.0, 2.0])
    ground = mbd.Ground()
    shafts = [mbd.RigidBody(name, 1.0, (x, 0.04, 0.04)) for name, x in zip(("left", "right", "cage"), J, strict=True)]
    hinges = [mbd.Revolute(ground.at(), shaft.at(), axis="x", name=f"{shaft.name}_hinge") for shaft in shafts]
    coupling = mbd.JointCoupling([hinge.angle for hinge in hinges], [1.0, 1.0, -2.0], name="gears")
    loads = [mbd.Torque(shaft.at(), (x, 0, 0)) for shaft, x in zip(shafts, torques.tolist(), strict=True)]
    motion = simulated(mbd.System(shafts, [*hinges, coupling], loads), 0.5, steps=25)
    c = np.array([1.0, 1.0, -2.0])
    solution = np.linalg.solve(np.block([[np.diag(J), c[:, None]], [c[None], np.zeros((1, 1))]]), [*torques, 0.0])
    spins = [float(motion.body(shaft.name).omega[0, -1, 0]) for shaft in shafts]
    np.testing.assert_allclose(spins, 0.5 * solution[:3], rtol=1e-10)
    for shaft, factor in zip(shafts, c, strict=True):
        load = mbd.Reaction("gears", "x", "torque", on=shaft.name)(motion)[0, -1]
        assert float(load) == pytest.approx(-factor * solution[3], rel=1e-9)


@pytest.mark.thorough
def test_geared_rotors_on_a_tumbling_body():
    """In free space: the ratio holds over turns of rotors and of what carries them, and angular momentum is conserved."""
    base = mbd.RigidBody("base", 3.0, (0.2, 0.3, 0.4), angular_velocity=(1.5, -2.0, 1.0))
    rotors, hinges = [], []
    for name, x, spin in (("fast", 0.1, 10.0), ("slow", -0.2, -4.0)):
        rotors.append(
            mbd.RigidBody(name, 0.5, (0.01, 0.012, 0.018), position=(x, 0, 0), angular_velocity=(1.5, -2.0, 1.0 + spin))
        )
        hinges.append(mbd.Revolute(base.at(x, 0, 0), rotors[-1].at(), name=f"{name}_hinge"))
    coupling = mbd.JointCoupling([hinge.angle for hinge in hinges], [1.0, 2.5])
    system = mbd.System([base, *rotors], [*hinges, coupling], free=["base"])
    motion = simulated(system, 2.0, steps=60)
    relative = [
        torch.einsum("tji,tjk->tik", motion.body("base").A[0], motion.body(name).A[0]) for name in ("fast", "slow")
    ]
    fast, slow = map(unwrapped, relative)
    assert fast[-1] > 2 * 2 * math.pi
    np.testing.assert_allclose(fast + 2.5 * slow, 0.0, atol=1e-8)


@pytest.mark.thorough
def test_flexible_bodies_carry_coupled_joints():
    """A wheel on the tip of a beam; its axis bends with the beam, and the ratio is that of the angles about the bent axes."""
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([0, 90, 0]), thickness=2e-3)
    plate = mbd.FlexibleBody.plate(
        "plate", mbd.mesh.rectangle(0.4, 0.05, cells=(4, 2)), laminate, modes=3, position=(0.2, 0, 0)
    )
    ground, wheel = mbd.Ground(), mbd.RigidBody("wheel", 0.2, (1e-3, 1e-3, 1e-3), position=(0.4, 0.0, 0.0))
    crank = mbd.Revolute(ground.at(), plate.at("left"), axis="z", name="crank")
    pin = mbd.Revolute(plate.at("right"), wheel.at(), axis="z", name="pin")
    system = mbd.System(
        [plate, wheel],
        [crank, pin, mbd.JointCoupling([crank.angle, pin.angle], [2.0, 1.0])],
        [mbd.Torque(wheel.at(), (0, 0, 0.1))],
        truncation=None,
    )
    motion = simulated(system, 0.5, steps=30)
    plate_angle, wheel_angle = angles(motion, "plate", "wheel")
    assert abs(wheel_angle[-1]) > 0.1
    np.testing.assert_allclose(
        wheel_angle, -plate_angle, atol=2e-2
    )  # wheel from plate: -2 times the angle of the plate


@pytest.mark.thorough
def test_redundant_couplings_are_named():
    base = gear()
    first, second = (joint.angle for joint in base.joints[:2])
    twice = mbd.System(base.bodies, [*base.joints, mbd.JointCoupling([first, second], [5.0, 2.0], name="belt")])
    assert (twice.describe().freedoms, len(twice.describe().redundant)) == (1, 1)
    locked = mbd.System(base.bodies, [*base.joints, mbd.JointCoupling([first, second], [1.0, 1.0], name="belt")])
    assert (locked.describe().freedoms, locked.describe().redundant) == (0, ())


@pytest.mark.thorough
@CLOSED
def test_a_system_with_couplings_is_pickled():
    system = pickle.loads(pickle.dumps(by_ratio_and_offset()))
    assert system.describe().freedoms == 1


def test_bad_input():
    base = gear()
    one, two, coupling = base.joints
    slide = mbd.Prismatic(mbd.Ground().at(), mbd.RigidBody("block", 1.0, (1.0, 1.0, 1.0)).at(), name="slide")
    for coordinates, factors, message in (
        ([one, two.angle], [1.0, 1.0], r"coordinates\[0\] = Revolute.*Try: hinge.angle"),
        ([one.angle], [1.0], "two or three"),
        ([one.angle, one.angle], [1.0, 1.0], "two or three different"),
        ([one.angle, two.angle], [1.0], "factors = .*2 numbers"),
        ([one.angle, two.angle], [1.0, 0.0], "factor2 = 0: must not be zero"),
        ([one.angle, two.angle], [1.0, math.nan], "factor2 = nan"),
        (one.angle, [1.0, 1.0], "coordinates = one.angle: must be a list"),
        (
            [one.angle, two.angle],
            [1.0, torch.tensor(1.0, requires_grad=True)],
            "factor2 .*must be a finite number",
        ),
    ):
        with pytest.raises(InputError, match=message):
            mbd.JointCoupling(coordinates, factors)
    with refused("gear.offset"):
        mbd.JointCoupling([one.angle, two.angle], [1.0, 1.0], math.inf, name="gear")
    with refused("joints.rack"):
        mbd.System(base.bodies, [*base.joints, mbd.JointCoupling([one.angle, slide.travel], [1.0, 1.0], name="rack")])
    with refused("phases.2.lock", "gear"):
        mbd.simulate(base, 1.0, steps=10, phases=[mbd.Phase(until=0.5), mbd.Phase(lock=["gear"])])
    assert repr(coupling) == "JointCoupling(2.5 one.angle + 1 two.angle = 0)"
