"""A motion that continues another one is the motion in one piece, but for errors of second order in the steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import INERTIA, box, tensor
from tests.physics.test_units_of_systems import SPRING, THOROUGH, World, mechanism

pytestmark = [pytest.mark.usefixtures("compiled"), pytest.mark.filterwarnings("ignore::UserWarning")]
GROUND = mbd.Ground()


def wheels() -> mbd.System:
    """A gear of two eccentric wheels, which turn several times, on a spring."""
    a, b = box("a", angular_velocity=(0.0, 0.0, 40.0)), box("b", position=(0.5, 0.0, 0.0))
    hinges = [
        mbd.Revolute(GROUND.at(), a.at(), "z", "first"),
        mbd.Revolute(GROUND.at(0.5, 0.0, 0.0), b.at(), "z", "second"),
    ]
    gear = mbd.JointCoupling([hinge.angle for hinge in hinges], [1.0, 2.0], name="gear")
    spring = mbd.SpringDamper(
        b.at(0.1, 0.0, 0.0), GROUND.at(0.5, 0.6, 0.0), mbd.variable(40.0), 0.3, 0.2, name="spring"
    )
    return mbd.System([a, b], [*hinges, gear], [spring], gravity=(1.5, -9.0, 3.5))


def sliding() -> mbd.System:
    """A ball on a rough floor."""
    ball = mbd.RigidBody(
        "ball", 0.7, INERTIA, position=(0.0, 0.0, 0.0999), velocity=(0.5, 0.2, 0.0), angular_velocity=(1.0, 2.0, 3.0)
    )
    floor = mbd.PlaneContact(
        GROUND.at(), ball.at(), "z", 0.1, mbd.variable(1e4), friction=0.3, speed=0.05, name="spring"
    )
    return mbd.System([ball], [], [floor], gravity=(0.0, 0.0, -9.81), free=["ball"])


def end(
    system: mbd.System, durations: Sequence[float], steps: int, phases: Sequence[list | None]
) -> tuple[Tensor, ...]:
    """Coordinates and rates at the end of a motion in pieces, and a number's derivative by the spring's stiffness."""
    motion, designs = None, {}
    if SPRING in dict(system.named_parameters()):
        designs = {SPRING: system.get_parameter(SPRING).detach()[None].requires_grad_()}
    for duration, of_piece in zip(durations, phases, strict=True):
        n = round(steps * duration / sum(durations))
        start = "assembled" if motion is None else motion
        motion = mbd.simulate(system, duration, steps=n, designs=designs, phases=of_piece, start=start)
    assert motion is not None
    assert motion.status == ["ok"]
    x = torch.cat([motion.q[0, -1], motion.v[0, -1]])
    if not designs:
        return (x.detach(),)
    number = (x * torch.linspace(1.0, 2.0, len(x), dtype=x.dtype)).sum()
    return x.detach(), torch.autograd.grad(number, designs[SPRING])[0]


def check(system: mbd.System, steps: int, one: tuple, several: tuple, largest: float) -> None:
    """Differences are small, and fall by four with half the step."""
    differences = []
    for n in (steps, 2 * steps):
        pairs = zip(end(system, one[0], n, one[1]), end(system, several[0], n, several[1]), strict=True)
        differences.append(tensor(*(float((x - y).abs().max() / x.abs().max()) for x, y in pairs)))
    assert float(differences[0].max()) < largest
    rate = (differences[0] / differences[1]).log2()
    assert float((rate - 2.0).abs().max()) < 0.15, (differences, rate)


@pytest.mark.parametrize(
    ("build", "duration", "steps", "largest"),
    [
        pytest.param(lambda: mechanism(World()), 0.2, 100, 2e-3, marks=THOROUGH),
        (wheels, 1.0, 500, 3e-6),
        (sliding, 0.1, 200, 1e-4),
    ],
    ids=["flexible", "gear", "friction"],
)
def test_a_motion_in_two_pieces(build: Callable[[], mbd.System], duration: float, steps: int, largest: float) -> None:
    halves = [0.5 * duration] * 2
    check(build(), steps, ([duration], [None]), (halves, [None, None]), largest)


@pytest.mark.parametrize("at", [0.3, 0.4])
def test_a_motion_that_ends_in_a_lock_goes_on(at: float) -> None:
    """The lock does not act in the second motion unless that has it too: at 0.3 s, within the phase, and at its end."""
    a, c = (mbd.RigidBody(x, 1.0, INERTIA, center=(0.3, 0.0, 0.0), position=(k, 0.0, 0.0)) for k, x in enumerate("ac"))
    joints = [
        mbd.Revolute(GROUND.at(), a.at(), "z", "shoulder"),
        mbd.Revolute(a.at(1.0, 0.0, 0.0), c.at(), "z", "elbow"),
    ]
    system = mbd.System([a, c], joints, gravity=(0.0, -9.81, 0.0))
    lock = ["elbow"]
    whole = [mbd.Phase(until=0.2), mbd.Phase(until=0.4, lock=lock), mbd.Phase()]
    first = [mbd.Phase(until=0.2), mbd.Phase(lock=lock)]
    second = None if at == 0.4 else [mbd.Phase(until=0.4 - at, lock=lock), mbd.Phase()]
    check(system, 600, ([0.6], [whole]), ([at, 0.6 - at], [first, second]), 1e-4)
