"""Histories with two values at one time, at a switch between phases: responses of a motion are those of its pieces."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.design import COMBINATORS, RESPONSES, History, Measure
from torchmbd.design.curve import samples_over_time
from torchmbd.integrate import Trajectory

DURATION, SWITCH, STEPS = 0.04, 0.016, 40  # the switch is at a time of the grid: pieces have the same steps
ITERATIONS = (12, 12)  # of a step: pieces are the same to rounding where its equations are solved
NAME = "arm.laminate.angles"
ANGLES = torch.deg2rad(torch.tensor([[40.0, -35.0], [70.0, 20.0]], dtype=torch.float64))
HISTORIES: dict[str, History] = {
    "strain_energy": mbd.StrainEnergy("arm"),
    "position": mbd.Position("arm", "y", node="right"),
    "displacement": mbd.Displacement("arm", "y", node="right"),
    "velocity": mbd.Velocity("arm", "y", node="right"),
    "acceleration": mbd.Acceleration("tool", "y"),
    "relative_displacement": mbd.RelativeDisplacement("arm", "right", "left", "z"),
    "reaction": mbd.Reaction("hinge", "y"),
    "angle": mbd.Angle("arm", "z"),
    "ply_failure": mbd.PlyFailure("arm"),
    "ply_stress": mbd.PlyStress("arm", "11", layer=1),
}
if "buckling" in mbd.__all__:  # the extension buckling is there
    HISTORIES["buckling_index"] = mbd.buckling.BucklingIndex("arm")
# What ends at the switch: one law of a force or, of a history that is refused where phases have laws of their own
# (tests/extensions/buckling/test_buckling_index.py), a free hinge.
LAW, FREE_HINGE = "law", "free hinge"
JUMP = {name: FREE_HINGE if name == "buckling_index" else LAW for name in HISTORIES}
MEASURES: dict[str, type[Measure]] = {
    name: kind for name, kind in COMBINATORS.items() if name not in ("at_time", "at_peaks")
}

# What a measure needs besides its history.
OPTIONS: dict[type[Measure], Callable[[History, Trajectory], dict]] = {
    mbd.AtTimes: lambda history, motion: {"count": 7},
    mbd.SmoothMax: lambda history, motion: {"scale": float(history(motion).abs().max())},
}


def arm_with_motor() -> mbd.System:
    arm = mbd.examples.arm()
    motor = mbd.RotationalSpringDamper(mbd.Ground().at(), arm.body("tool").at(), axis="z", law=first_law, name="motor")
    return mbd.System(arm.bodies, arm.joints, [motor], gravity=(0, -9.81, 0))


def first_law(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    return 3.0 - 0.5 * rate - 2.0 * s


def second_law(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    return -9.0 - 0.5 * rate - 2.0 * s


@pytest.fixture(scope="module")
def whole_and_pieces(native) -> Callable[[str, str], tuple[Trajectory, Trajectory]]:
    """By mode of gradients and JUMP: a motion whose torque or rates jump, and its first piece."""
    system = arm_with_motor()
    seconds = {LAW: mbd.Phase(laws={"motor": second_law}), FREE_HINGE: mbd.Phase(lock=["hinge"])}

    @cache
    def motions(mode: str, jump: str) -> tuple[Trajectory, Trajectory]:
        common = {"designs": {NAME: ANGLES}, "variables": [NAME], "iterations": ITERATIONS, "gradients": mode}
        common |= {"backend": "native"}  # a dozen corrections of every row of cotangents: eager steps take minutes
        whole = mbd.simulate(system, DURATION, steps=STEPS, phases=[mbd.Phase(lasting=SWITCH), seconds[jump]], **common)
        before = mbd.simulate(system, SWITCH, steps=16, phases=[mbd.Phase()], **common)
        return whole.require_ok(), before.require_ok()

    return motions


def test_every_registered_history_is_here():
    assert {name: type(history) for name, history in HISTORIES.items()} == RESPONSES


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["reverse", pytest.param("forward", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", HISTORIES)
def test_a_window_that_ends_at_a_switch_is_the_motion_before(name, mode, whole_and_pieces):
    """Values and gradients of every measure of every history."""
    history, (whole, before) = HISTORIES[name], whole_and_pieces(mode, JUMP[name])
    for kind in MEASURES.values():
        options = OPTIONS[kind](history, before) if kind in OPTIONS else {}
        alone, part = kind(history, **options), kind(history, window=(0.0, SWITCH), **options)
        expected, result = alone.of(before), part.of(whole)
        assert_close(result.value, expected.value, rtol=1e-7, atol=1e-9 * float(expected.value.abs().max()))
        assert_close(
            result.gradient, expected.gradient, rtol=0, atol=1e-6 * float(expected.gradient.abs().max()) + 1e-15
        )


@pytest.mark.thorough
@pytest.mark.parametrize("name", HISTORIES)
def test_measures_of_the_whole_are_those_of_both_sides(name, whole_and_pieces):
    history, (whole, _) = HISTORIES[name], whole_and_pieces("reverse", JUMP[name])
    sides = (0.0, SWITCH), (SWITCH, DURATION)
    for kind, join in ((mbd.Integral, torch.add), (mbd.Max, torch.maximum), (mbd.Min, torch.minimum)):
        expected = join(*(kind(history, window=side)(whole) for side in sides))
        assert_close(kind(history)(whole), expected, rtol=1e-9, atol=1e-12 * float(expected.abs().max()))
    start = mbd.AtTimes(history, window=sides[1], count=2)(whole)[:, 0]
    assert_close(mbd.AtTime(history, SWITCH)(whole), start, rtol=1e-9, atol=0.0)
    end = mbd.Final(history, window=sides[0])(whole)
    times, values = samples_over_time(history, whole, 0)
    first = int((times < SWITCH - 1e-9).sum())
    assert_close(values[first], end[0], rtol=1e-9, atol=0.0)
    assert_close(values[first + 1], start[0], rtol=1e-9, atol=0.0)


G, HEIGHT, E = 9.81, 0.5, 0.7
SPEED = math.sqrt(2.0 * G * HEIGHT)


def ball() -> mbd.System:
    start = torch.nn.Parameter(torch.tensor([0.0, 0.0, HEIGHT], dtype=torch.float64))
    body = mbd.RigidBody("ball", 1.0, (0.01,) * 3, position=start)
    return mbd.System([body], gravity=(0, 0, -G), free=["ball"])


def bounce(system: mbd.System, steps: int = 100, **options) -> Trajectory:
    hit = mbd.Event(mbd.Position("ball", "z"), "falling")
    return mbd.simulate(system, 0.5, steps=steps, phases=[mbd.Phase(until=hit, impact=E), mbd.Phase()], **options)


VZ, Z = mbd.Velocity("ball", "z"), mbd.Position("ball", "z")
T = SPEED / G  # of the impact
END = E * SPEED - G * (0.5 - T)
# Values, and derivatives by the height h with v = sqrt(2 g h): dv/dh = g / v, dT/dh = 1 / v.
EXPECTED = [
    (mbd.Max(VZ), E * SPEED, E * G / SPEED),
    (mbd.Min(VZ), -SPEED, -G / SPEED),
    (mbd.Min(Z), 0.0, 0.0),
    (mbd.AtTime(VZ, T + 1e-4), E * SPEED - G * 1e-4, (1.0 + E) * G / SPEED),
    (mbd.AtTime(VZ, T - 1e-4), -SPEED + G * 1e-4, 0.0),
    (mbd.Final(VZ), END, (1.0 + E) * G / SPEED),
    (mbd.Integral(VZ), -HEIGHT + E * SPEED * (0.5 - T) - 0.5 * G * (0.5 - T) ** 2, None),
    (mbd.Max(VZ, window=(0.2, 0.45)), E * SPEED, E * G / SPEED),
    (mbd.AtPeaks(VZ, count=2), (E * SPEED, 0.0), (E * G / SPEED, 0.0)),
]
if "equivalent_load" in COMBINATORS:  # half cycles from 0 to -v, to e v, to the end: ranges v, (1 + e) v, e v - end
    load = mbd.fatigue.EquivalentLoad(VZ, exponent=3.0, cycles=1.0)
    ranges = SPEED, (1.0 + E) * SPEED, E * SPEED - END
    EXPECTED.append((load, (0.5 * sum(x**3 for x in ranges)) ** (1.0 / 3.0), None))


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["reverse", "forward"])
@pytest.mark.parametrize("steps", [100, 317])
def test_a_ball_that_bounces(steps, mode):
    """At any number of steps: the spline through the jump was 22 % off, its gradient 2.7 times too large."""
    system = ball()
    motion = bounce(system, steps, gradients=mode, variables=["ball.position"])
    for measure, value, slope in EXPECTED:
        result, gradient = measure.value_and_gradient(motion)
        expected = torch.tensor(value, dtype=torch.float64).reshape(result[0].shape)
        assert_close(result[0], expected, rtol=1e-9, atol=1e-9, msg=str(measure))
        if slope is not None:
            expected = torch.tensor(slope, dtype=torch.float64).reshape(result[0].shape)
            assert_close(gradient[0, ..., 2], expected, rtol=1e-8, atol=1e-8, msg=str(measure))


@pytest.mark.thorough
def test_lanes_switch_at_times_of_their_own():
    """A batch is as each design alone, and as torch.func.vmap."""
    system, measures = ball(), [measure for measure, _, _ in EXPECTED]
    heights = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.61], [0.0, 0.0, 0.3]], dtype=torch.float64)

    def values(position: Tensor) -> Tensor:
        motion = bounce(system, designs={"ball.position": position})
        return torch.cat([measure(motion).reshape(len(position), -1) for measure in measures], 1)

    together = values(heights)
    for lane in range(3):
        assert_close(values(heights[lane : lane + 1])[0], together[lane], rtol=0, atol=1e-12)
    assert_close(torch.func.vmap(lambda x: values(x[None])[0])(heights), together, rtol=0, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.extensions
def test_damage_counts_the_cycles_of_both_sides():
    curve = mbd.fatigue.SNCurve([(1e2, 4.0), (1e6, 0.5)])
    motion = bounce(ball(), gradients="none")
    ranges = torch.tensor([SPEED, (1.0 + E) * SPEED, E * SPEED - END], dtype=torch.float64)
    means = torch.tensor([-0.5 * SPEED, 0.5 * (E - 1.0) * SPEED, 0.5 * (E * SPEED + END)], dtype=torch.float64)
    expected = (0.5 / curve.cycles(0.5 * ranges, means)).sum()
    assert_close(mbd.fatigue.Damage(VZ, curve=curve)(motion)[0], expected, rtol=1e-9, atol=0.0)


@pytest.mark.thorough
def test_a_displacement_since_the_start_has_both_sides():
    """At a switch it is that of the whole motion, not of the switch alone: its integral saw zeros there."""
    system = ball()
    motion = bounce(system, 400, gradients="none")
    fall = mbd.Displacement("ball", "z")
    expected = mbd.Integral(Z)(motion) - HEIGHT * 0.5
    assert_close(mbd.Integral(fall)(motion), expected, rtol=1e-12, atol=0.0)
    assert_close(mbd.Min(fall)(motion)[0], torch.tensor(-HEIGHT, dtype=torch.float64), rtol=1e-12, atol=0.0)
