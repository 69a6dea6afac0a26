"""Design variables in laws of drives and forces: gradients of the motion against central differences, on both routes."""

from __future__ import annotations

import math

import pytest
import torch
import torchdiffeq
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import SOFT, box, laminate, plate, tensor, turned
from tests.refused import refused

GROUND = mbd.Ground()
TIGHT = {"iterations": (6, 4)}


class Swing(nn.Module):
    """A law of one's own: two amplitudes in one parameter, and a fixed rate."""

    def __init__(self):
        super().__init__()
        self.sizes = nn.Parameter(tensor(0.3, -0.1))
        self.register_buffer("rate", tensor(9.0)[0])

    def forward(self, t: Tensor) -> Tensor:
        return self.sizes[0] * (1.0 - torch.cos(self.rate * t)) + self.sizes[1] * torch.sin(2.0 * self.rate * t)


LAWS = {
    "step": {"angle": lambda: mbd.SmoothStep(mbd.variable(0.5), mbd.variable(0.13), start=mbd.variable(0.004))},
    "sine": {"angle": lambda: mbd.Sine(mbd.variable(0.3), mbd.variable(4.0))},
    "speed": {"speed": lambda: mbd.variable(3.0)},
    "own": {"angle": Swing},
}


def arm(law: str = "step") -> mbd.System:
    """A motor turns an arm about a leaning axis; the arm carries a soft plate on a hinge."""
    lean = turned(0.3, -0.2, 0.5)
    hub = box("hub", position=(0.1, 0.0, 0.2), axes=turned(0.2, 0.1, -0.4))
    tip = tensor(0.2, 0.05, 0.0)
    swing = turned(-0.5, 0.2, 0.9)
    origin = hub.position + hub.axes @ tip - swing @ tensor(-0.15, 0.0, 0.0)
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), position=origin, axes=swing)
    foot = GROUND.at(0.1, 0.0, 0.2, axes=lean)
    joints = [
        mbd.Revolute(foot, hub.at(), name="foot"),
        mbd.Drive(foot, hub, name="motor", **{name: make() for name, make in LAWS[law].items()}),
        mbd.Revolute(hub.at(*tip.tolist()), rod.at("left"), axis="y", name="hinge"),
    ]
    return mbd.System([hub, rod], joints, gravity=(0.0, -9.81, 0.0))


def names(system: mbd.System) -> list[str]:
    return [name for name, _ in system.named_parameters() if name.startswith("motor")]


def differences(system: mbd.System, variables: list[str], run, size: float = 1e-5) -> Tensor:
    """Central differences of run(designs) [lanes, ...] by all entries of the variables [..., n_b], in one batch."""
    own = {name: system.get_parameter(name).detach() for name in variables}
    flat = torch.cat([x.flatten() for x in own.values()])
    step = size * torch.eye(len(flat), dtype=flat.dtype)
    batch, designs, start = torch.cat([flat + step, flat - step]), {}, 0
    for name, x in own.items():
        designs[name] = batch[:, start : start + x.numel()].reshape(-1, *x.shape)
        start += x.numel()
    plus, minus = run(designs).chunk(2)
    return ((plus - minus) / (2.0 * size)).movedim(0, -1)


@pytest.mark.thorough
@pytest.mark.parametrize("law", LAWS)
def test_drives_by_the_structural_integrator(law):
    system = arm(law)
    variables = [*names(system), "rod.laminate.angles"]

    def run(designs: dict[str, Tensor] | None = None, **more) -> mbd.Trajectory:
        return mbd.simulate(system, 0.1, steps=40, designs=designs, **TIGHT, **more).require_ok()

    motion = run(gradients="forward", variables=variables)
    assert motion.dq_db is not None
    result = differences(system, variables, lambda designs: run(designs).q)
    assert_close(motion.dq_db[0], result, rtol=0, atol=1e-6 * float(result.abs().amax()))
    for k in range(result.shape[-1]):
        assert float(result[..., k].abs().max()) > 1e-3


@pytest.mark.thorough
def test_drives_by_torchdiffeq():
    """The index-1 equations with their own slopes of the law; forward by pairs, in reverse mode, and differences."""
    system = arm("step")
    variables = names(system)

    def run(designs: dict[str, Tensor] | None = None, **more) -> mbd.Trajectory:
        return mbd.simulate(system, 0.03, method="rk4", steps=8, designs=designs, **more).require_ok()

    motion = run(gradients="forward", variables=variables)
    assert motion.dq_db is not None
    result = differences(system, variables, lambda designs: run(designs).q)
    assert_close(motion.dq_db[0], result, rtol=0, atol=1e-6 * float(result.abs().amax()))
    dynamics = system().dynamics
    end = torchdiffeq.odeint(dynamics, dynamics.initial_state(), motion.t, method="rk4")[-1, 0, : motion.q.shape[2]]
    k = int(result[-1].abs().amax(-1).argmax())
    slopes = torch.autograd.grad(end[k], [system.get_parameter(name) for name in variables])
    assert_close(torch.stack(slopes), motion.dq_db[0, -1, k], rtol=1e-6, atol=1e-9)


@pytest.mark.thorough
def test_a_design_is_a_system_of_its_own():
    """A lane of a batch moves as a system that was built with its numbers, reactions and energies alike."""
    system, own = arm("sine"), arm("sine")
    designs = {"motor.amplitude": tensor(0.3, 0.2), "motor.frequency": tensor(4.0, 5.0)}
    with torch.no_grad():
        own.get_parameter("motor.amplitude").fill_(0.2)
        own.get_parameter("motor.frequency").fill_(5.0)
    both = mbd.simulate(system, 0.1, steps=40, designs=designs).require_ok()
    alone = mbd.simulate(own, 0.1, steps=40).require_ok()
    assert_close(both.q[1], alone.q[0], rtol=0, atol=1e-12)
    for joint in ("motor", "foot", "hinge"):
        for part in ("force", "torque"):
            x, y = (getattr(motion.reaction(joint), part) for motion in (both, alone))
            assert_close(x[1], y[0], rtol=0, atol=1e-9 * max(1.0, float(y.abs().max())))
    assert_close(both.energies.driven[1], alone.energies.driven[0], rtol=1e-9, atol=1e-12)
    balance = alone.energies.balance.abs().max() / alone.energies.kinetic.max()
    assert float(balance) < 2e-3


@pytest.mark.thorough
def test_reactions_beside_a_body_that_is_guided():
    """Its rows are solved for good: their multipliers come from equations in which the drive of another body varies."""
    system = arm("sine")
    hub, rod = system.bodies
    end = rod.position + rod.axes @ tensor(0.15, 0.0, 0.0)
    wheel = box("wheel", center=(0.0, 0.0, 0.0), position=end + tensor(0.0, 0.3, 0.1))
    link = mbd.DistanceJoint(wheel.at(0.1, 0.0, 0.0), rod.at("right"), length=float(tensor(0.1, 0.3, 0.1).norm()))
    joints = [*system.joints, mbd.Revolute(GROUND.at(*wheel.position.tolist()), wheel.at(), name="axle"), link]
    system = mbd.System([hub, rod, wheel], joints, gravity=(0.0, -9.81, 0.0))
    with torch.no_grad():
        assert system.dynamics().condensed().topology.n_v < system.topology.n_v
    pull = mbd.Mean(mbd.Reaction("axle", (1.0, -1.0, 0.5)))

    def run(designs: dict[str, Tensor] | None = None, **more) -> mbd.Trajectory:
        return mbd.simulate(system, 0.1, steps=40, designs=designs, **TIGHT, **more).require_ok()

    variables = names(system)
    exact = pull.value_and_gradient(run(gradients="forward", variables=variables)).gradient[0]
    result = differences(system, variables, lambda designs: pull.value(run(designs)))
    assert_close(exact, result, rtol=1e-6, atol=0.0)


@pytest.mark.thorough
def test_phases_with_a_drive_that_varies():
    """The drive lets go at a position of the hub: the time of the switch follows the law's variables."""
    system = arm("step")
    variables = names(system)

    def angle(motion: mbd.Trajectory) -> Tensor:
        return motion.body("hub").at((1.0, 0.0, 0.0)).position[..., 2] - 0.1

    phases = [mbd.Phase(until=mbd.Event(angle)), mbd.Phase(release=["motor"])]

    def run(designs: dict[str, Tensor] | None = None, **more) -> mbd.Trajectory:
        return mbd.simulate(system, 0.1, steps=40, phases=phases, designs=designs, **TIGHT, **more).require_ok()

    motion = run(gradients="forward", variables=variables)
    (switch,) = motion.switches
    assert motion.dq_db is not None
    exact = torch.cat([switch.dt_db, motion.dq_db[0, -1]])

    def times_and_ends(designs: dict[str, Tensor]) -> Tensor:
        moved = run(designs)
        return torch.cat([moved.switches[0].t[:, None], moved.q[:, -1]], 1)

    assert_close(exact, differences(system, variables, times_and_ends, 1e-6), rtol=0, atol=1e-6)


def sprung() -> mbd.System:
    """A plate that hangs on a spring, a torsion spring and an actuator, all of which vary."""
    body = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), axes=turned(0.3, 0.2, -0.4))
    tip, root = body.at("right"), body.at("left")
    place = body.position + body.axes @ tensor(-0.15, 0.0, 0.0)

    def push(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return torch.sin(20.0 * t) - 0.2 * s * s - 0.01 * rate

    here = GROUND.at(*place.tolist(), axes=body.axes)
    forces = [
        mbd.SpringDamper(
            GROUND.at(0.1, 0.3, 0.1), tip, mbd.variable(40.0), mbd.variable(0.2), mbd.variable(0.25), name="cord"
        ),
        mbd.RotationalSpringDamper(here, root, stiffness=mbd.variable(0.5), rest=mbd.deg(20.0), name="coil"),
        mbd.RotationalSpringDamper(here, root, law=mbd.forces.Scaled(mbd.variable(0.4), push), name="muscle"),
    ]
    return mbd.System([body], [mbd.Revolute(here, root, name="pin")], forces, gravity=(0.0, -9.81, 0.0))


FORCES = ["cord.stiffness", "cord.damping", "cord.rest", "coil.stiffness", "muscle.factor"]


@pytest.mark.thorough
@pytest.mark.parametrize(("method", "options"), [("generalized_alpha", TIGHT), ("rk4", {})])
def test_forces(method, options):
    system = sprung()
    assert {name for name, _ in system.named_parameters() if name[:3] != "rod"} == set(FORCES)

    def run(designs: dict[str, Tensor] | None = None, **more) -> mbd.Trajectory:
        return mbd.simulate(system, 0.06, method=method, steps=15, designs=designs, **options, **more).require_ok()

    motion = run(gradients="forward", variables=FORCES)
    result = differences(system, FORCES, lambda designs: run(designs).q, 1e-4)
    assert motion.dq_db is not None
    sizes = result.abs().amax((0, 1))
    assert float(sizes.min()) > 1e-6
    assert float(((motion.dq_db[0] - result).abs().amax((0, 1)) / sizes).max()) < 1e-6


@pytest.mark.thorough
def test_forces_are_those_of_a_system_of_its_own():
    """The first of two lanes is the system as it stands; the other one that was built with its numbers."""
    system, own = sprung(), sprung()
    with torch.no_grad():
        own.get_parameter("cord.stiffness").fill_(60.0)
    designs = {"cord.stiffness": tensor(40.0, 60.0)}
    both = mbd.simulate(system, 0.06, steps=15, designs=designs).require_ok()
    for lane, alone in enumerate((system, own)):
        motion = mbd.simulate(alone, 0.06, steps=15).require_ok()
        assert_close(both.q[lane], motion.q[0], rtol=0, atol=1e-12)
        assert_close(both.energies.applied[lane], motion.energies.applied[0], rtol=1e-9, atol=1e-12)


def waves(t: Tensor) -> Tensor:
    return torch.stack([torch.sin(20.0 * t), 0.5 + 0.0 * t, t])


def loaded() -> mbd.System:
    """A plate and a box under loads, pressures and a bushing of which numbers vary; some start at zero."""
    varies, rod = (
        mbd.variable,
        plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), axes=turned(0.3, 0.2, -0.4)),
    )
    arm, tip = box("arm", position=(0.4, 0.1, 0.0)), rod.at("right")
    both, gust = varies(0.01), mbd.forces.Scaled(varies(3.0), lambda t: torch.cos(10.0 * t))
    forces = [
        mbd.Force(tip, (varies(0.3), 0.0, 0.2), name="push"),
        mbd.Force(arm.at(), mbd.forces.Scaled(varies(0.4), waves), axes="frame", name="wave"),
        mbd.Torque(arm.at(), (0.0, varies(0.0), 0.0), name="turn"),
        mbd.Bushing(
            rod.at("left"), arm.at(), varies(30.0), (0.1, varies(0.2), 0.0), (0.2, 0.1, varies(0.05)), name="mount"
        ),
        mbd.Pressure(rod, varies(5.0), name="wind"),
        mbd.Pressure(rod, gust, direction=(1.0, 2.0, 0.0), name="gust"),
        mbd.SpringDamper(GROUND.at(0.0, 0.5, 0.0), tip, both, both, 0.2, name="cord"),
    ]
    return mbd.System([rod, arm], [mbd.Spherical(GROUND.at(), rod.at("left"))], forces, free=["arm"])


LOADS = ["push.x", "wave.factor", "turn.y", "mount.stiffness", "mount.damping_y", "mount.turning_stiffness_z"]
LOADS += ["wind.pressure", "gust.factor", "cord.stiffness"]


@pytest.mark.thorough
@pytest.mark.parametrize(("method", "options"), [("generalized_alpha", TIGHT), ("rk4", {})])
def test_loads_and_bushings(method, options):
    system = loaded()
    assert {name for name, _ in system.named_parameters() if name[:3] != "rod"} == set(LOADS)

    def run(designs: dict[str, Tensor] | None = None, **more) -> mbd.Trajectory:
        return mbd.simulate(system, 0.06, method=method, steps=15, designs=designs, **options, **more).require_ok()

    motion = run(gradients="forward", variables=LOADS)
    result = differences(system, LOADS, lambda designs: run(designs).q, 1e-4)
    assert motion.dq_db is not None
    sizes = result.abs().amax((0, 1))
    assert float(sizes.min()) > 1e-4
    assert float(((motion.dq_db[0] - result).abs().amax((0, 1)) / sizes).max()) < 1e-6
    energies = motion.energies
    assert float(energies.balance.abs().max()) < 1e-2 * float(energies.applied.abs().max())


def test_variables_where_they_would_not_be_differentiated():
    hub = box("hub")
    with refused("spring.law"):
        mbd.SpringDamper(GROUND.at(), hub.at(), law=torch.nn.Linear(1, 1).double(), name="spring")  # pyright: ignore
    with refused("push.law"):
        mbd.Force(hub.at(), torch.nn.Linear(1, 3).double(), name="push")  # pyright: ignore
    stiffness = mbd.variable(2.0)
    with refused("spring.law"):
        mbd.SpringDamper(GROUND.at(), hub.at(), law=lambda s, rate, t: -stiffness * s, name="spring")
    system = sprung()
    phases = [mbd.Phase(until=0.01), mbd.Phase(laws={"coil": mbd.forces.Spring(mbd.variable(1.0))})]  # pyright: ignore
    with refused("coil in phase 2.law"):
        mbd.simulate(system, 0.02, steps=4, phases=phases)


def test_what_names_of_laws_may_not_be():
    def made(name: str, twice: bool = False) -> mbd.System:
        hub, tail = box("hub"), box("tail")
        joints: list = [mbd.Revolute(GROUND.at(), hub.at()), mbd.Revolute(GROUND.at(), tail.at())]
        joints += [mbd.Drive(GROUND, hub, name=name, speed=mbd.variable(1.0))]
        joints += [mbd.Drive(GROUND, tail, name=name, speed=1.0)] * twice
        return mbd.System([hub, tail], joints)

    for given in (("hub",), ("a.b",), ("motor", True)):
        with pytest.raises(mbd.InputError, match="has design variables: must have an explicit name without a point"):
            made(*given)
    with refused("variable", float("nan")):
        mbd.variable(math.nan)
    with refused("motor.speed"):
        mbd.Drive(GROUND, box("hub"), name="motor", speed=nn.Parameter(torch.ones(2)))  # pyright: ignore
