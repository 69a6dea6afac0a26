"""Vibrations of whole systems are the same in other units, at another place, in another direction and with other names."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.physics.test_units_of_systems import ANGLES, SPRING, THOROUGH, WORLDS, Facts, World, check, mechanism

pytestmark = [pytest.mark.filterwarnings("ignore::UserWarning")]  # of unusual units and of what the model leaves out


def numbers(x: Tensor) -> Tensor:
    """Real and imaginary parts, without a graph."""
    return torch.view_as_real(x.detach()) if x.is_complex() else x.detach()


def response(w: World, system: mbd.System, state: mbd.Trajectory) -> tuple[mbd.vibrations.LinearSystem, Tensor]:
    """The linearized system, and its response by a torque at the hinge, in SI units."""
    joints = {joint.name: joint for joint in system.joints}
    ports = (
        [mbd.signals.JointTorque(joints[w.name("hinge")])],
        [mbd.signals.JointAngle(joints[w.name("axle")]), mbd.signals.JointRate(joints[w.name("axle")])],
    )
    linear = mbd.vibrations.linearize(system, *ports, state)
    G = torch.from_numpy(linear.response(w([0.3, 1.0, 5.0, 20.0], 0, 0, -1))) * w.units.factor(2, 1, -2)
    return linear, numbers(G * tensor(1.0, w.units.time)[:, None])


def at_rest(w: World) -> Facts:
    """Poles and responses of a mechanism at an unstable equilibrium, in SI units."""
    system = mechanism(w)
    rest = mbd.equilibrium(system, unstable=True)
    linear, G = response(w, system, rest)
    values = {
        "frequencies": rest.frequencies[0] * w.units.time,
        "poles": rest.poles[0] * w.units.time,
        "damping ratios": rest.damping_ratios[0],
        "response": G,
    }
    places = {name: w.back(rest.body(w.name(name)).r[0]) for name in ("slider", "nut", "sheet")}
    said = {"status": rest.status, "stable": rest.stable, "states": len(linear.states)}
    return Facts({name: numbers(x) for name, x in (values | places).items()}, {}, said)


def moving(w: World) -> Facts:
    """About a state of a motion: its coordinates, on which frozen poles depend, are chosen without units."""
    system = mechanism(w)
    motion = mbd.simulate(system, w(0.02, 0, 0, 1), steps=200, backend="eager", gradients="none")
    linear, G = response(w, system, motion)
    poles = mbd.vibrations.frozen_poles(motion)[0] * w.units.time
    said = {"states": sorted(name.replace(w.prefix, "") for name in linear.states)}
    return Facts({}, {"response": G, "poles": numbers(poles)}, said)


def rotor(w: World) -> Facts:
    """A disk in anisotropic bearings, about an axis through its center. At rest two vibrations have the same frequency."""
    u, J = w.units, w(torch.diag(tensor(0.02, 0.01, 0.01)), 2, 1)
    disk = mbd.RigidBody(w.name("disk"), w(2.0, 0, 1), J, position=w.point(0.4, 0.2, 0.1), axes=w.turn)
    bearing = mbd.Bushing(
        w.ground(0.4, 0.2, 0.1),
        disk.at(),
        stiffness=w((5e4, 8e3, 5e3), 0, 1, -2),
        damping=w((5.0, 8.0, 3.0), 0, 1, -1),
        turning_stiffness=w((0.0, 30.0, 30.0), 2, 1, -2),
        turning_damping=w((0.0, 0.03, 0.03), 2, 1, -1),
    )
    system = mbd.System([disk], forces=[bearing], free=[disk.name])
    motion = mbd.simulate(system, w(1e-4, 0, 0, 1), steps=2, backend="eager", gradients="none")
    V, axis, center = mbd.vibrations, w.vector((1.0, 0.0, 0.0)), w.point(0.4, 0.2, 0.1)
    options = {"axis": axis, "center": center, "observer": "ground"}
    speed, between = w(20.0, 0, 0, -1), (w(10.0, 0, 0, -1), w(90.0, 0, 0, -1))
    drawn = V.campbell(system, w([0.0, 10.0, 20.0, 30.0], 0, 0, -1), axis, center, "ground")
    values = {
        "critical speed": V.CriticalSpeed(2, between=between, **options)(motion) * u.time,
        "frequency": V.SystemFrequency(3, speed=speed, **options)(motion) * u.time,
        "damping": V.DampingRatio(2, speed=speed, **options)(motion),
        "margin": V.StabilityMargin(sharpness=w(3.0, 0, 0, 1), speed=speed, **options)(motion) * u.time,
        "diagram": drawn.frequencies[0] * u.time,
    }
    return Facts(values, {}, {"whirl": drawn.whirl.tolist(), "status": drawn.status})


CASES: dict[str, Callable[[World], Facts]] = {"at rest": at_rest, "moving": moving, "rotor": rotor}
IN_SI = cache(lambda name: CASES[name](World()))
QUICK = {("at rest", "um, ug, ms"), ("moving", "mm, t, s"), ("rotor", "elsewhere in mm")}


@pytest.mark.parametrize(
    ("name", "world"),
    [pytest.param(x, w, marks=() if (x, w) in QUICK else THOROUGH) for x in CASES for w in WORLDS],
)
def test_vibrations_are_the_same_in_any_world(name: str, world: str) -> None:
    check(
        CASES[name](WORLDS[world]), IN_SI(name), of_derived=1e-5
    )  # of iterations of steps, in which small speeds differ


def test_a_turning_disk_whirls_both_ways() -> None:
    """Disks stiffen forward whirl; at rest both have one frequency, and the backward one comes first."""
    assert [row[1:3] for row in IN_SI("rotor").said["whirl"][0]] == [[0, 0]] + [[-1, 1]] * 3


@THOROUGH
def test_vibrations_of_a_design_are_the_same_alone_and_in_a_batch() -> None:
    """Values, and derivatives of some of them."""
    system, V = mechanism(World()), mbd.vibrations
    angles = torch.stack([mbd.deg(x) for x in ([20.0, -50.0], [35.0, -10.0], [80.0, 5.0])])
    stiffness = tensor(40.0, 60.0, 20.0)
    results = []
    for lanes in ([0, 1, 2], [1]):
        designs = {SPRING: stiffness[lanes].requires_grad_(), ANGLES: angles[lanes].requires_grad_()}
        motion = mbd.simulate(system, 0.01, steps=100, designs=designs, backend="eager")
        measures = [
            V.SystemFrequency(3),
            V.DampingRatio(2),
            V.FrequencyResponse("sheet", "leaf", (0.5, 12.0), place="right", direction="y"),
        ]
        values = [measure(motion) for measure in measures]
        by_design = torch.autograd.grad(torch.stack(values).sum(), list(designs.values()), retain_graph=True)
        values += [V.frozen_poles(motion), mbd.equilibrium(system, designs=designs, unstable=True).poles]
        lane = lanes.index(1)
        results.append([numbers(x[lane]) for x in (*values, *by_design)])
    for x, y in zip(*results, strict=True):
        torch.testing.assert_close(x, y, rtol=0.0, atol=1e-9 * float(y[y.isfinite()].abs().max()), equal_nan=True)
