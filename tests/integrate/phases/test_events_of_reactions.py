"""Events that read forces and accelerations: their times are those of closed forms, off the grid, whatever the steps.

A block rests on a table that shakes by A sin(w t) and leaves it when A w^2 sin(w t) = g. A ball slides down a sphere, held to
its center by a rod: the rod's force vanishes at cos(angle) = 2/3 from the top (2/3 cos of where it is let go).
"""

from __future__ import annotations

import math

import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

import torchmbd as mbd
from tests.refused import refused
from torchmbd.integrate import Trajectory

G, AMPLITUDE, SPEED = 9.81, 0.05, 20.0
LIFT_OFF = math.asin(G / (AMPLITUDE * SPEED**2)) / SPEED  # [s]


def shaken() -> mbd.System:
    """A block on a table; its mass is a variable, on which the time does not depend."""
    ground = mbd.Ground()
    table = mbd.RigidBody("table", 1.0, (1.0, 1.0, 1.0))
    block = mbd.RigidBody("block", mbd.variable(0.5), (0.1, 0.1, 0.1))
    joints = [
        mbd.Prismatic(ground.at(), table.at(), axis="z", name="rail"),
        mbd.Drive(ground, table, axis="z", position=mbd.Sine(AMPLITUDE, SPEED / (2.0 * math.pi)), name="shaker"),
        mbd.Fixed(table.at(), block.at(), name="rest"),
    ]
    return mbd.System([table, block], joints, gravity=(0.0, 0.0, -G))


LIFTS = {
    "reaction": lambda motion: mbd.Reaction("rest", "z").values(motion),
    "acceleration": lambda motion: motion.body("block").at().acceleration[..., 2] + G,
    "multiplier": lambda motion: motion.reaction("rest").force[..., 2],
}


@pytest.mark.thorough
@pytest.mark.parametrize("function", LIFTS)
@pytest.mark.parametrize(
    ("steps", "options"),
    [(100, {}), (230, {}), (100, {"spectral_radius": 1.0}), (100, {"method": "hht_alpha"}), (60, {"method": "dopri5"})],
)
def test_a_shaken_block_leaves_its_table_in_time(function, steps, options):
    phases = [mbd.Phase(until=mbd.Event(LIFTS[function])), mbd.Phase(release=["rest"])]
    motion = mbd.simulate(shaken(), 0.25, steps=steps, phases=phases, gradients="none", **options).require_ok()
    time = motion.switches[0].t.item()
    assert time == pytest.approx(LIFT_OFF, rel=1e-6)
    assert abs(time / (0.25 / steps) - round(time / (0.25 / steps))) > 0.05
    end = motion.body("block").r[0, -1, 2]  # in free flight since
    since = 0.25 - LIFT_OFF
    height, rise = AMPLITUDE * math.sin(SPEED * LIFT_OFF), AMPLITUDE * SPEED * math.cos(SPEED * LIFT_OFF)
    assert end.item() == pytest.approx(height + rise * since - 0.5 * G * since**2, rel=2e-3)


START = 0.3  # [rad] from the top


def sliding() -> mbd.System:
    """A ball that a rod of one meter holds to the origin, let go near the top; its weight is a variable [N]."""
    ball = mbd.RigidBody("ball", 2.0, (0.1, 0.1, 0.1), position=(math.sin(START), 0.0, math.cos(START)))
    rod = mbd.DistanceJoint(mbd.Ground().at(), ball.at(), 1.0, name="rod")
    return mbd.System([ball], [rod], [mbd.Force(ball.at(), (0.0, 0.0, mbd.variable(-2.0 * G)), name="weight")])


def time_on_the_sphere() -> float:
    """The integral of the angle over its rate, sqrt(2 g (cos a0 - cos a)), with a = a0 + s^2."""
    end = math.acos(2.0 / 3.0 * math.cos(START))

    def slowness(s: float) -> float:
        fall = 2.0 * math.sin(START + 0.5 * s * s) * math.sin(0.5 * s * s)
        return 2.0 * s / math.sqrt(2.0 * G * fall) if s else 2.0 / math.sqrt(2.0 * G * math.sin(START))

    return quad(slowness, 0.0, math.sqrt(end - START), epsabs=1e-13)[0]


def force_of_the_rod(motion: Trajectory) -> Tensor:
    return motion.lam[..., 0]


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["forward", "reverse"])
def test_time_and_derivative_converge(gradients):
    """A weight n times as large shortens the time by the square root of n: dt/dF = -t / (2 F)."""
    phases = [mbd.Phase(until=mbd.Event(force_of_the_rod)), mbd.Phase(release=["rod"])]
    exact, errors = time_on_the_sphere(), []
    for steps in (160, 320):  # of fewer steps the error has parts of higher order
        motion = mbd.simulate(sliding(), 1.2, steps=steps, phases=phases, gradients=gradients).require_ok()
        (switch,) = motion.switches
        if gradients == "forward":
            assert switch.dt_db is not None
            slope = float(switch.dt_db[0, 0])
        else:
            slope = float(torch.autograd.grad(switch.t.sum(), list(motion.variables.values()))[0])
        time = float(switch.t.detach())
        assert slope == pytest.approx(time / (4.0 * G), rel=3e-4)
        errors.append(abs(time / exact - 1.0))
        assert force_of_the_rod(motion)[0, : int(time / 1.2 * steps)].abs().min() > 0.1
    assert errors[1] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.4)


@pytest.mark.thorough
def test_a_time_without_a_derivative_is_refused_by_name():
    """A function that jumps has no rate where it does, and one that stays zero no event."""
    ends = mbd.Event(lambda motion: torch.where(motion.body("ball").r[..., 2] > 0.2, 1.0, -1.0).double(), "falling")
    never = mbd.Event(lambda motion: 0.0 * motion.body("ball").r[..., 2])
    options = {"steps": 40, "backend": "eager"}
    phases = [mbd.Phase(until=ends), mbd.Phase()]
    forward = mbd.simulate(sliding(), 1.2, phases=phases, gradients="forward", **options)
    assert "failed: the function of the event of phase '1' has no rate" in forward.status[0]
    reverse = mbd.simulate(sliding(), 1.2, phases=phases, gradients="reverse", **options)
    with refused("phases.1.until"):
        torch.autograd.grad(reverse.switches[0].t.sum(), list(reverse.variables.values()))
    motion = mbd.simulate(sliding(), 1.2, phases=[mbd.Phase(until=never), mbd.Phase()], gradients="forward", **options)
    assert "its event does not occur" in motion.status[0]
