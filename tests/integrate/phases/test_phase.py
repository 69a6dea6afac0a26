"""Phases: locks and releases that keep momentum and position, lanes that switch at their own times, and bad input."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, box, pendulum, random_state, turned
from tests.refused import refused
from tests.sensitivity.test_law_variables import arm
from torchmbd.integrate import Trajectory
from torchmbd.integrate.phases.switch import data_with_marks
from torchmbd.multibody.equations import equations
from torchmbd.multibody.joints.lock import Lock
from torchmbd.results.time_rows import TensorSignals

GROUND = mbd.Ground()
NAME = "rod.laminate.angles"
TIP = torch.tensor([0.3031, -0.0302, 0.1815], dtype=torch.float64)  # of the arm, where it starts


def rotors(hinges: int = 1) -> mbd.System:
    """A rotor on the ground's z-axis carries another off it; both spin. No gravity: momentum about z stays.

    A second hinge on the same axis is redundant.
    """
    first = box("first", angular_velocity=(0.0, 0.0, 3.0))
    second = box("second", position=(0.4, 0.1, 0.2), axes=turned(0.0, 0.0, 0.5), angular_velocity=(0.0, 0.0, -8.0))
    return mbd.System(
        bodies=[first, second],
        joints=[
            mbd.Revolute(GROUND.at(), first.at(), axis="z", name="shaft"),
            mbd.Revolute(first.at(0.4, 0.1, 0.2), second.at(), axis="z", name="hinge"),
            mbd.Revolute(first.at(0.4, 0.1, 0.3), second.at(0.0, 0.0, 0.1), axis="z", name="second_hinge"),
        ][: 1 + hinges],
    )


def momentum(motion: Trajectory, state: tuple[Tensor, Tensor]) -> Tensor:
    """Angular momentum about the ground's z-axis [lanes] of a state (q, v) [lanes, n]."""
    there = replace(motion, signals=TensorSignals({"q": state[0][:, None], "v": state[1][:, None]}))
    total = torch.zeros(len(state[0]), dtype=torch.float64)
    for name in ("first", "second"):
        body, view = motion.system.body(name), there.body(name)
        A, center = view.A[:, 0], view.at(tuple(body.center.tolist()))
        second = body.second_moment
        J = torch.trace(second) * torch.eye(3, dtype=torch.float64) - second
        spin = (A @ (J @ view.omega[:, 0].T).T[..., None])[..., 0]
        total = total + spin[:, 2] + body.mass * torch.linalg.cross(center.position[:, 0], center.velocity[:, 0])[:, 2]
    return total


@pytest.mark.thorough
@pytest.mark.parametrize(("method", "hinges"), [("generalized_alpha", 1), ("generalized_alpha", 2), ("dopri5", 1)])
def test_a_lock_keeps_momentum_and_position(method, hinges):
    phases = [mbd.Phase(until=0.0325), mbd.Phase(lock=["hinge"])]
    motion = mbd.simulate(rotors(hinges), 0.1, method, 20, phases=phases).require_ok()
    (switch,) = motion.switches
    before, after = (momentum(motion, (side.q, side.v)) for side in (switch.before, switch.after))
    assert_close(after, before, rtol=1e-12, atol=0)
    end = momentum(motion, (motion.q[:, -1], motion.v[:, -1]))
    assert_close(end, before, rtol=1e-5 if method == "generalized_alpha" else 1e-8, atol=0)
    omega = [motion.body(name).omega[0, :, 2] for name in ("first", "second")]
    assert float((omega[0] - omega[1]).abs()[:7].min()) > 5.0
    assert_close(omega[0][7:], omega[1][7:], rtol=0, atol=1e-9)
    relative = motion.body("first").A[0].mT @ motion.body("second").A[0]
    assert_close(relative[7:], relative[7:8].expand(14, 3, 3), rtol=0, atol=1e-8)
    # The jump is the one that loses least: M (v+ - v-) does no work on any motion that the locked joints allow.
    assert float(motion.v[0, 0].abs().max()) == pytest.approx(8.0, rel=1e-12)
    assert float(switch.before.v.abs().max()) > 6.0


@pytest.mark.thorough
def test_a_lock_from_the_start_holds_the_initial_position():
    motion = mbd.simulate(rotors(), 0.05, steps=10, phases=[mbd.Phase(lock=["hinge"])]).require_ok()
    relative = motion.body("first").A[0].mT @ motion.body("second").A[0]
    assert_close(relative, turned(0.0, 0.0, 0.5).expand(11, 3, 3), rtol=0, atol=1e-11)
    rows = [name.startswith("lock of hinge") for name in motion.dynamics.topology.row_names]
    assert sum(rows) == 1
    assert float(motion.lam[0, :, torch.tensor(rows)].abs().min()) > 1e-3


@pytest.mark.parametrize("hinges", [1, 2])
def test_a_motion_is_printed_whose_lock_does_not_hold_at_the_start(hinges):
    """The rotors turn by a radian against each other before they are locked: the rank is that of each phase."""
    phases = [mbd.Phase(until=0.1), mbd.Phase(lock=["hinge"])]
    motion = mbd.simulate(rotors(hinges), 0.12, steps=12, phases=phases, backend="eager").require_ok()
    assert ("over-constraint" in repr(motion)) == (hinges == 2)


@pytest.mark.thorough
def test_the_frames_of_a_locked_sliding_joint_stay_where_they_are():
    """A lock of a translation, on a flexible body: the marked point moves with its node."""
    system = pendulum()
    arm, rod = system.body("arm"), system.body("rod")
    slide = mbd.Cylindrical(arm.at(0.2, 0.1, -0.05), rod.at("left"), axis="x", name="slide")
    sliding = mbd.System(system.bodies, [system.joints[0], slide], gravity=GRAVITY)
    phases = [mbd.Phase(until=0.031), mbd.Phase(lock=["slide"])]
    motion = mbd.simulate(sliding, 0.06, steps=30, phases=phases).require_ok()
    tip, point = motion.body("arm").at((0.2, 0.1, -0.05)).position, motion.body("rod").at("left").position
    offset = torch.einsum("tji,tj->ti", motion.body("arm").A[0], (point - tip)[0])
    assert float(offset[:15].norm(dim=1).max()) > 1e-3
    assert_close(offset[16:], offset[16:17].expand(15, 3), rtol=0, atol=1e-10)


def pushed(angle: float) -> mbd.System:
    """A driven arm with a bob on a spherical joint."""
    arm = box("arm", position=(0.3, 0.0, 0.0))
    bob = box("bob", position=(0.6, 0.0, -0.2))
    return mbd.System(
        bodies=[arm, bob],
        joints=[
            mbd.Revolute(GROUND.at(), arm.at(-0.3, 0.0, 0.0), axis="z", name="shaft"),
            mbd.Drive(GROUND, arm, axis="z", angle=lambda t: angle * torch.sin(9.0 * t), name="motor"),
            mbd.Universal(arm.at(0.3, 0.0, 0.0), bob.at(0.0, 0.0, 0.2), axes="yx", name="hook"),
        ],
        gravity=GRAVITY,
    )


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "dopri5"])
def test_laws_go_on_through_phases(method):
    """Phases without locks are the motion without phases; the drive's law is a function of absolute time."""
    system, options = pushed(0.7), {"rtol": 1e-6, "atol": 1e-8} if method == "dopri5" else {"iterations": (5, 1)}
    phases = [mbd.Phase(until=0.023), mbd.Phase(lasting=0.02), mbd.Phase()]
    steps = 5 if method == "dopri5" else 50
    result, whole = (
        mbd.simulate(system, 0.05, method, steps, phases=p, **options).require_ok() for p in (phases, None)
    )
    assert_close(result.q, whole.q, rtol=0, atol=1e-5)
    angle = 0.7 * torch.sin(9.0 * result.t)
    assert_close(result.body("arm").A[0, :, 0, 0], torch.cos(angle), rtol=0, atol=1e-6)
    assert_close(result.body("arm").omega[0, :, 2], 6.3 * torch.cos(9.0 * result.t), rtol=0, atol=2e-4)
    assert [float(s.t) for s in result.switches] == pytest.approx([0.023, 0.043])


@pytest.mark.thorough
def test_a_released_drive_leaves_the_arm_its_velocity():
    phases = [mbd.Phase(until=0.02), mbd.Phase(release=["motor"])]
    motion = mbd.simulate(pushed(0.7), 0.06, steps=60, phases=phases, iterations=(5, 1)).require_ok()
    (switch,) = motion.switches
    # The last step leaves velocities that fit the joints to the order of the method.
    assert_close(switch.after.v, switch.before.v, rtol=0, atol=2e-4)
    rows = torch.tensor([name.startswith("motor") for name in motion.dynamics.topology.row_names])
    assert float(motion.lam[0, :20, rows].abs().min()) > 0.1
    assert float(motion.lam[0, 21:, rows].abs().max()) == 0.0


def tip(motion: Trajectory) -> Tensor:
    return motion.body("rod").at("right").position[..., 2] + 0.0155


@pytest.mark.thorough
def test_lanes_switch_at_their_own_times_and_do_not_interact():
    system = pendulum(damping=1e-4)
    designs = mbd.deg([[20.0, -50.0], [-30.0, 40.0], [80.0, 10.0]])
    phases = [mbd.Phase(until=mbd.Event(tip, "falling")), mbd.Phase(lock=["universal_arm_rod"])]
    together = mbd.simulate(system, 0.05, steps=25, designs={NAME: designs}, phases=phases).require_ok()
    times = together.switches[0].t
    assert len({round(float(t), 7) for t in times}) == 3
    for lane in range(3):
        alone = mbd.simulate(system, 0.05, steps=25, designs={NAME: designs[lane : lane + 1]}, phases=phases)
        assert_close(alone.q[0], together.q[lane], rtol=0, atol=1e-12)
        assert_close(alone.switches[0].t[0], times[lane], rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_tangents_before_a_lane_arrives_are_not_looked_at():
    """A lane waits for its switch with a state that its drive, far behind, does not suit: that says nothing of it."""
    system = arm("step")
    designs = {"motor.size": torch.tensor([0.5, 0.25], dtype=torch.float64)}

    def way(motion: Trajectory) -> Tensor:
        tip = motion.body("hub").at((0.2, 0.05, 0.0)).position
        return (tip - TIP).norm(dim=-1) - 0.045

    options = {
        "steps": 80,
        "phases": [mbd.Phase(until=mbd.Event(way)), mbd.Phase()],
        "gradients": "forward",
        "variables": ["motor.size"],
    }
    together = mbd.simulate(system, 0.2, designs=designs, **options).require_ok()
    assert float(together.switches[0].t.diff()) > 0.03
    for lane in range(2):
        alone = mbd.simulate(system, 0.2, designs={"motor.size": designs["motor.size"][lane:][:1]}, **options)
        assert_close(together.stats["tangent_error"][lane], alone.stats["tangent_error"][0], rtol=0, atol=1e-9)


@pytest.mark.thorough
def test_a_phase_that_never_ends_is_the_status_of_its_lane():
    """The threshold lies between what the designs reach."""
    system = pendulum(damping=1e-4)
    designs = {NAME: mbd.deg([[20.0, -50.0], [80.0, 10.0]])}
    heights = mbd.simulate(system, 0.05, steps=25, designs=designs).body("rod").at("right").position[..., 2].amin(1)
    level = float(heights.mean())
    event = mbd.Event(lambda motion: motion.body("rod").at("right").position[..., 2] - level)
    phases = [mbd.Phase(until=event, name="fall"), mbd.Phase()]
    motion = mbd.simulate(system, 0.05, steps=25, designs=designs, phases=phases)
    deeper = int(heights.argmin())
    assert motion.status[deeper] == "ok"
    assert motion.status[1 - deeper] == (
        "failed: phase 'fall' never ends: its event does not occur before the simulation ends at t = 0.05 s"
    )
    assert torch.isfinite(motion.q[deeper]).all()
    motion = mbd.simulate(rotors(), 0.1, steps=5, phases=[mbd.Phase(lasting=0.2), mbd.Phase()])
    assert motion.status == [
        "failed: phase '1' never ends: it lasts beyond the end of the simulation at t = 0.1 s",
    ]


@pytest.mark.thorough
@pytest.mark.parametrize(("restitution", "backend"), [(0.0, "eager"), (0.6, "native")])
def test_a_jointed_body_rebounds_from_a_wall(restitution, backend, native):
    """A pendulum that hits a wall turns back with its own restitution; the joint takes an impulse as well."""
    arm = box("arm", axes=turned(0.0, 1.2, 0.0), angular_velocity=(0.0, 2.0, 0.0))
    system = mbd.System([arm], [mbd.Revolute(GROUND.at(), arm.at(-0.5, 0.0, 0.0), axis="y")], gravity=(0.0, 0.0, -9.81))
    gap = mbd.Event(lambda motion: 0.05 - motion.body("arm").at((0.5, 0.0, 0.0)).position[..., 0])
    phases = [mbd.Phase(until=gap, impact=restitution), mbd.Phase()]
    motion = mbd.simulate(system, 0.3, "rk4", steps=150, phases=phases, backend=backend).require_ok()
    (switch,) = motion.switches
    assert float(switch.before.v[0, 4].abs()) > 1.0
    assert_close(switch.after.v[0, 4], -restitution * switch.before.v[0, 4], rtol=0, atol=1e-6)
    after = motion.at_moment(0, switch.t[0], switch.after).body("arm").at((-0.5, 0.0, 0.0)).velocity
    assert_close(after, torch.zeros_like(after), rtol=0, atol=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
def test_velocities_follow_a_drive_whose_rate_jumps_at_a_switch(method):
    """A bob hangs on a driven arm: the jump of the arm is an impulse at the pin, about which the bob keeps its momentum."""
    arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.02), position=(0.3, 0.0, 0.0))
    bob = mbd.RigidBody("bob", 0.5, (0.01, 0.01, 0.01), position=(0.9, 0.0, 0.0))
    joints = [
        mbd.Revolute(GROUND.at(), arm.at(-0.3, 0.0, 0.0), axis="z"),
        mbd.Drive(GROUND, arm, axis="z", angle=lambda t: torch.where(t < 0.1, 0.0 * t, 5.0 * (t - 0.1))),
        mbd.Revolute(arm.at(0.3, 0.0, 0.0), bob.at(-0.3, 0.0, 0.0), axis="z"),
    ]
    phases = [mbd.Phase(until=0.1), mbd.Phase()]
    motion = mbd.simulate(mbd.System([arm, bob], joints), 0.2, method, steps=40, phases=phases, gradients="none")
    motion.require_ok()
    (switch,) = motion.switches
    after = motion.at_moment(0, switch.t[0], switch.after)
    pin, turn = 0.6 * 5.0, -0.5 * 0.3 * (0.6 * 5.0) / (0.5 * 0.3**2 + 0.01)  # [m/s], [rad/s]
    assert float(after.body("arm").omega[0, 0, 2]) == pytest.approx(5.0, abs=1e-9)
    assert float(after.body("bob").at((-0.3, 0.0, 0.0)).velocity[0, 0, 1]) == pytest.approx(pin, abs=1e-9)
    assert float(after.body("bob").omega[0, 0, 2]) == pytest.approx(turn, abs=1e-9)
    first = int((motion.t > 0.1 + 1e-9).nonzero()[0])
    assert float(motion.body("bob").omega[0, first, 2]) == pytest.approx(turn, rel=0.01)


class TestDoor:
    def refused(self, match: str, phases, system: mbd.System | None = None) -> None:
        with pytest.raises(mbd.InputError, match=match):
            mbd.simulate(system or pushed(0.7), 0.1, steps=10, phases=phases)

    def test_a_drive_on_a_locked_joint(self):
        self.refused(
            "phase '1' locks 'shaft', which 'motor' drives. Try: release=..motor..", [mbd.Phase(lock=["shaft"])]
        )

    def test_unknown_joints(self):
        self.refused(
            "lock of phase 'a': joint = 'shift': must be .* Try: 'shaft'", [mbd.Phase(lock=["shift"], name="a")]
        )
        self.refused("release of phase '1': joint = 'x': must be", [mbd.Phase(release=["x"])])

    def test_a_phase_without_an_end(self):
        self.refused("phase '1' never ends: must have until or lasting", [mbd.Phase(), mbd.Phase()])

    def test_a_last_phase_with_an_end(self):
        self.refused("phase '1' is the last phase, but it has until or lasting", [mbd.Phase(until=0.05)])

    def test_times_that_do_not_increase(self):
        phases = [mbd.Phase(until=0.05), mbd.Phase(until=0.03), mbd.Phase()]
        self.refused(r"until of the phases = \[0.05, 0.03\] s: must be increasing times before duration=0.1", phases)

    def test_both_locked_and_released(self):
        self.refused("both locks and releases 'hook'", [mbd.Phase(lock=["hook"], release=["hook"])])

    def test_joints_of_one_name(self):
        system = rotors()
        for joint in system.joints:
            vars(joint)["name"] = "hinge"
        self.refused("joints have the names hinge more than once", [mbd.Phase(until=0.05), mbd.Phase()], system)

    @pytest.mark.parametrize(
        "given",
        [
            {"until": 0.0},
            {"until": "soon"},
            {"lasting": -1.0},
            {"until": 1.0, "lasting": 1.0},
            {"lock": "shaft"},
            {"impact": 0.5},
            {"until": mbd.Event(tip), "impact": 1.5},
        ],
    )
    def test_phase(self, given):
        with pytest.raises(mbd.InputError) as error:
            mbd.Phase(**given)
        assert error.value.path[-1] in given
        assert error.value.allowed

    def test_event(self):
        with refused("function", 3):
            mbd.Event(3)
        for direction in ("up", ["falling"]):
            with refused("direction"):
                mbd.Event(tip, direction)
        phases = [mbd.Phase(until=mbd.Event(lambda motion: motion.t)), mbd.Phase()]
        self.refused(r"the function of an event returned shape \(1,\): must return a tensor", phases)

    @pytest.mark.parametrize(("velocities", "words"), [(lambda m: m.v[..., :2], "shape"), (lambda m: 3.0, "3.0")])
    def test_impact(self, velocities, words):
        """The tip passes zero height at once: the map is called."""
        phases = [mbd.Phase(until=mbd.Event(lambda m: m.t.expand(m.lanes, -1) - 0.01), impact=velocities), mbd.Phase()]
        self.refused(rf"the impact of a phase returned {words}.*must return a tensor \[lanes, times, n_v\]", phases)

    def test_a_joint_that_begins_to_act_must_be_closed(self):
        phases = [mbd.Phase(until=0.05, release=["hinge"]), mbd.Phase()]
        motion = mbd.simulate(rotors(), 0.1, steps=10, phases=phases)
        assert "hinge: coincide" in motion.status[0]
        assert "when phase '2' begins at t = 0.05 s: a joint that begins to act must be closed" in motion.status[0]


@pytest.mark.thorough
def test_energy_lost_at_switches():
    """The balance goes on through locks and impacts to second order, and a lock loses what a plastic joint does."""
    phases = [mbd.Phase(until=0.0325), mbd.Phase(until=0.06, lock=["hinge"]), mbd.Phase()]
    motion = mbd.simulate(rotors(), 0.1, steps=20, phases=phases).require_ok()
    energies = motion.energies
    drop = energies.kinetic[0, 6] - energies.kinetic[0, 7]
    assert float(drop) > 0.05 * float(energies.kinetic[0, 0])
    assert_close(energies.lost[0, 7:12], drop.expand(5), rtol=1e-3, atol=0)
    assert float(energies.lost[0, :7].abs().max()) == 0.0
    errors = []
    halves = [mbd.Phase(until=0.022), mbd.Phase(lock=["hook"])]  # the switch lies on the grid
    for steps in (30, 60):
        motion = mbd.simulate(pushed(0.7), 0.06, steps=steps, phases=halves, iterations=(5, 1)).require_ok()
        energies = motion.energies
        errors.append(float(energies.balance.abs().max()))
        assert float(energies.lost[0, -1].abs()) > 10.0 * errors[-1]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.3)


@pytest.mark.thorough
def test_a_lock_on_a_bent_body_is_closed():
    """Axes of a frame on a bent body are not quite perpendicular to each other; the lock holds what is there."""
    system = pendulum()
    arm, rod = system.body("arm"), system.body("rod")
    ball = mbd.Spherical(rod.at("left", axes=turned(0.4, -0.3, 0.7)), arm.at(0.2, 0.1, -0.05), name="ball")
    loose = mbd.System(system.bodies, [system.joints[0], ball], gravity=tuple(10.0 * g for g in GRAVITY))
    phases = [mbd.Phase(until=0.021), mbd.Phase(lock=["ball"])]
    motion = mbd.simulate(loose, 0.04, steps=160, phases=phases).require_ok()
    rotation = motion.modes("rod")[0, rod.mesh.node("left"), 3:] @ motion.body("rod").w[0, 84]
    assert float(rotation.norm()) ** 2 > 1e-6  # by how much the axes are not perpendicular


@pytest.mark.parametrize("bent", ["a", "b"])
def test_marks_of_a_lock_are_closed_on_a_bent_body(bent):
    """Its equations hold to rounding where they begin, although axes of a bent body are a square of its rotation off."""
    system = pendulum()
    arm, rod = system.body("arm"), system.body("rod")
    frames = [rod.at("right", axes=turned(0.4, -0.3, 0.7)), arm.at(0.2, 0.1, -0.05)]
    lock = Lock(mbd.Spherical(*(frames if bent == "a" else frames[::-1]), name="ball"), "lock of ball")
    T, dynamics = (loose := mbd.System(system.bodies, [system.joints[0], lock])).topology, loose.dynamics()
    q, *_ = random_state(loose, 1, bend=0.05)
    turn = rod.structure()["psi"][rod.mesh.node("right"), 3:].detach() @ q[-rod.modes :, 0, 0]
    assert float(turn.norm()) > 0.05
    data = data_with_marks(T, dynamics.data, q, [lock])
    at = equations.placement(T, data, q, T.prescribed(torch.zeros((), dtype=torch.float64), data))
    phi = equations.constraints(T, at)[torch.tensor([name.startswith("lock of ball") for name in T.row_names])]
    assert len(phi) == 3
    assert float(phi.detach().abs().max()) < 1e-14


@pytest.mark.thorough
def test_a_motion_that_is_not_finite_is_the_status_of_its_lane():
    body = box("block")
    push = mbd.Force(body.at(), lambda t: torch.stack([torch.where(t > 0.03, torch.nan, 1.0)] * 3))
    phases = [mbd.Phase(until=0.05), mbd.Phase()]
    motion = mbd.simulate(mbd.System([body], [], [push]), 0.1, steps=10, phases=phases)
    assert "not finite" in motion.status[0]


@pytest.mark.thorough
def test_lanes_that_do_not_reach_a_lock_leave_the_others_alone():
    """The lock has no marks in a lane that never gets there, be it the first or all of them."""
    system = pendulum(damping=1e-4)
    angles = mbd.deg([[20.0, -50.0], [80.0, 10.0]])
    heights = mbd.simulate(system, 0.05, steps=25, designs={NAME: angles}).body("rod").at("right").position[..., 2]
    deeper = int(heights.amin(1).argmin())
    ordered = angles[[1 - deeper, deeper]]
    for level, ends in ((float(heights.amin(1).mean()), [False, True]), (-9.0, [False, False])):
        event = mbd.Event(lambda motion, z=level: motion.body("rod").at("right").position[..., 2] - z)
        phases = [mbd.Phase(until=event), mbd.Phase(lock=["universal_arm_rod"])]
        motion = mbd.simulate(system, 0.05, steps=25, designs={NAME: ordered}, phases=phases)
        assert [status == "ok" for status in motion.status] == ends
        if any(ends):
            alone = mbd.simulate(system, 0.05, steps=25, designs={NAME: ordered[1:]}, phases=phases)
            assert_close(motion.q[1], alone.q[0], rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_steps_that_are_too_long_are_unresolved_with_phases_as_without():
    """Three steps for half a second of an arm that vibrates at 30 Hz: the status says so, whether there is a phase or not."""
    plain = mbd.simulate(mbd.examples.arm(modes=4), 0.5, steps=3, gradients="none")
    phased = mbd.simulate(mbd.examples.arm(modes=4), 0.5, steps=3, gradients="none", phases=[mbd.Phase()])
    assert plain.status[0].startswith("unresolved: ")
    assert phased.status == plain.status


def falling() -> mbd.System:
    bob = mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01), position=(0.0, 0.0, 1.0))
    return mbd.System([bob], gravity=(0.0, 0.0, -10.0), free=["bob"])


@pytest.mark.parametrize("steps", [10, 77])
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
@pytest.mark.parametrize(
    "function",
    [
        lambda m: m.q[..., 2] - m.q[:, :1, 2] + 0.2,
        lambda m: m.q[..., 2] - m.q[:, -1:, 2] - 0.2,
        mbd.history(lambda m: m.q[..., 2] - m.q[..., 2].mean(1, True)) + 0.2,
    ],
)
def test_an_event_of_other_times_than_its_own_is_refused(function, method, steps):
    """Such a function has other values in every part of a motion that is looked at."""
    phases = [mbd.Phase(until=mbd.Event(function)), mbd.Phase()]
    with refused("function", function):
        mbd.simulate(falling(), 1.0, method, steps, phases=phases)


def test_an_event_of_a_displacement_since_the_start_is_refused():
    for function in (mbd.Displacement("bob", "z") + 0.2, 2.0 * mbd.Displacement("bob", "z", seen_from="ground")):
        with refused("function", function):
            mbd.Event(function)
    mbd.Event(mbd.Displacement("arm", "z", node="right"))  # elastic: a function of the state


@pytest.mark.parametrize("speed", [0.625, 1.0, 1.25, 2.0, 4.0])
def test_an_event_at_the_end_of_a_step_is_found(speed):
    """Where rounding leaves the function at -1e-16 after a step, the next one does not count it as the begin of a phase."""
    drum = mbd.RigidBody("drum", 1.0, (1.0, 1.0, 1.0))
    joints = [mbd.Revolute(mbd.Ground().at(), drum.at(), axis="z")]
    joints.append(mbd.Drive(mbd.Ground(), drum, axis="z", speed=speed))
    turned_by_one = mbd.Event(mbd.Angle("drum", "z") - 1.0, "rising")
    phases = [mbd.Phase(until=turned_by_one), mbd.Phase()]
    for steps in (40, 80):
        motion = mbd.simulate(mbd.System([drum], joints), 2.0, steps=steps, phases=phases)
        assert motion.status == ["ok"]
        assert motion.switches[0].t.item() == pytest.approx(1.0 / speed, rel=1e-12)
