"""Laws with jumps, as eq. (39): their pieces as phases between events, beside the same law with smoothed jumps."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum, tensor
from tests.refused import refused
from torchmbd.multibody.forces import OfTime, Pieces, Spring

GROUND, MASS, FIRST, SECOND, BORDER = mbd.Ground(), 2.0, 3.0, -5.0, 0.4
NAME = "rod.laminate.angles"


class Pushed(mbd.System):
    """A mass on a rail under a field along it that is a design variable, and an actuator."""

    def __init__(self, law):
        body = mbd.RigidBody("mass", MASS, (0.1, 0.1, 0.1))
        push = mbd.AxialSpringDamper(GROUND.at(), body.at(), axis="x", law=law, name="actuator")
        super().__init__([body], [mbd.Prismatic(GROUND.at(), body.at(), axis="x")], [push])
        self.g = nn.Parameter(tensor(1.0))

    def _data(self, stages):
        zero = torch.zeros_like(self.g)
        return super()._data(stages) | {"gravity": torch.stack([self.g, zero, zero]).reshape(3, 1, 1, -1)}


def place(t: Tensor, g: Tensor) -> Tensor:
    """Constant acceleration before the border and after it."""
    before, after = g + FIRST / MASS, g + SECOND / MASS
    switch = torch.sqrt(2.0 * BORDER / before)
    if t < switch:
        return 0.5 * before * t * t
    return BORDER + before * switch * (t - switch) + 0.5 * after * (t - switch) ** 2


PIECES = [
    mbd.Phase(until=mbd.Event(lambda motion: motion.body("mass").r[..., 0] - BORDER)),
    mbd.Phase(laws={"actuator": OfTime(SECOND)}),
]


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
def test_a_jump_located_has_its_closed_form(method):
    fields = tensor(1.0, 0.4, 2.3)
    options = {"gradients": "forward", "variables": ["g"], "designs": {"g": fields[:, None]}, "phases": PIECES}
    motion = mbd.simulate(Pushed(OfTime(FIRST)), 1.0, method, 30, **options).require_ok()
    assert motion.dq_db is not None
    for lane, g in enumerate(fields):
        exact = torch.stack([place(t, g) for t in motion.t])
        slope = torch.stack([torch.func.jacfwd(lambda x, t=t: place(t, x))(g) for t in motion.t])  # pyright: ignore
        assert_close(motion.q[lane, :, 0], exact, rtol=0, atol=1e-10)
        assert_close(motion.dq_db[lane, :, 0, 0], slope, rtol=0, atol=1e-10)
    energies = motion.energies
    gained = MASS * fields[:, None] * motion.q[..., 0] + FIRST * BORDER + SECOND * (motion.q[..., 0] - BORDER)
    after = motion.t > motion.switches[0].t[:, None]
    assert_close(energies.kinetic[after], gained[after], rtol=0, atol=1e-9)
    assert float(energies.balance.abs().max()) < 1e-9


@pytest.mark.thorough
def test_a_jump_smoothed_comes_near_it():
    errors = []
    for width in (0.04, 0.02):
        law = Pieces((BORDER,), (FIRST, SECOND), (0.0, 0.0), width)
        motion = mbd.simulate(Pushed(law), 1.0, steps=200).require_ok()
        errors.append(float((motion.q[0, -1, 0] - place(tensor(1.0)[0], tensor(1.0)[0])).abs()))
    assert errors[1] < 0.5 * errors[0] < 5e-3


def swinging(law) -> mbd.System:
    """The double pendulum with a flexible rod, its hinge driven by an actuator with a jump."""
    free = pendulum(damping=1e-4)
    hinge = free.joints[0]
    motor = mbd.RotationalSpringDamper(hinge.a, hinge.b, axis="x", law=law, name="motor")
    return mbd.System(free.bodies, free.joints, [motor], gravity=free.gravity)


def tip(motion: mbd.Trajectory) -> Tensor:
    """Passes zero on the way."""
    return motion.body("rod").at("right").position[..., 2] + 0.0155


@pytest.mark.thorough
def test_gradients_through_both_against_differences():
    exact = [mbd.Phase(until=mbd.Event(tip, "falling")), mbd.Phase(laws={"motor": Spring(2.0, 0.01, 0.3)})]
    smooth = Pieces((0.05,), (1.0, -1.5), (-3.0, 2.0), width=0.02, damping=0.01)
    h, way = 2e-5, tensor(1.0, 0.4)
    for law, phases in ((Spring(5.0), exact), (smooth, None)):
        system = swinging(law)
        b = dict(system.named_parameters())[NAME].detach()
        designs = {NAME: torch.stack([b, b + h * way, b - h * way])}
        options = {"gradients": "forward", "designs": designs, "phases": phases, "iterations": (8, 6)}
        motion = mbd.simulate(system, 0.06, steps=60, **options).require_ok()
        assert motion.dq_db is not None
        rigid = slice(14)
        result, expected = motion.dq_db[0, :, rigid] @ way, (motion.q[1] - motion.q[2])[:, rigid] / (2.0 * h)
        assert_close(result, expected, rtol=0, atol=1e-4 * float(expected.abs().max()))
        assert float(motion.energies.balance.abs().max()) < 2e-2 * float(motion.energies.kinetic.max())


def test_bad_laws_of_phases_are_named():
    for laws, path in (
        ({"motr": OfTime(1.0)}, "phases.2.laws"),
        ({"actuator": 3.0}, "actuator in phase 2.law"),
        ({"actuator": OfTime(float("nan"))}, "actuator in phase 2.law"),
    ):
        with refused(path):
            mbd.simulate(Pushed(OfTime(1.0)), 1.0, steps=10, phases=[PIECES[0], mbd.Phase(laws=laws)])
