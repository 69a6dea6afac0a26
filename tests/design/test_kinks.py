"""Histories with kinks and jumps between their samples: no extremum that the motion does not have, at any number of steps."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.design.spline import Spline

pytestmark = pytest.mark.usefixtures("compiled")
G, GROUND = 9.81, mbd.Ground()
ACCELERATION, SPEED = mbd.Acceleration("ball", "z"), mbd.Velocity("ball", "z")


def bent(kink: Tensor, rates: tuple[float, float], n: int = 11) -> tuple[Spline, Callable[[Tensor], Tensor]]:
    """Two straight pieces, sampled at n times in 0..1, and the function itself."""

    def f(t: Tensor) -> Tensor:
        return torch.where(t < kink, rates[0] * (t - kink), rates[1] * (t - kink))

    t = torch.linspace(0.0, 1.0, n, dtype=torch.float64)
    kinks = ((t[:-1] <= kink) & (kink < t[1:]))[None]
    return Spline.of(t, f(t)[None], kinks=kinks), f


@pytest.mark.parametrize("rates", [(0.0, 1.0), (1.0, -10.0), (-1.0, 3.0), (2.0, 0.5)])
@pytest.mark.parametrize("kink", [0.0, 0.05, 0.3, 0.331, 0.35, 0.36, 0.399, 0.95])
def test_a_curve_beside_a_kink_is_between_the_chord_and_the_function(kink, rates):
    curve, f = bent(torch.tensor(kink, dtype=torch.float64), rates)
    times = torch.linspace(0.0, 1.0, 1001, dtype=torch.float64)
    function, result = f(times), curve.at(times)[0]
    place = times * 10.0
    i = place.long().clamp(0, 9)
    chord = torch.lerp(curve.y[0, i], curve.y[0, i + 1], place - i)
    low, high = torch.minimum(chord, function), torch.maximum(chord, function)
    assert bool(((result >= low - 1e-12) & (result <= high + 1e-12)).all())
    most = abs(rates[1] - rates[0]) * 0.1**2 / 8.0  # of the chord, of two samples at an end
    assert_close(curve.integral()[0], torch.trapezoid(function, times), rtol=0, atol=most * (1.0 + 1e-9))


def test_measures_are_continuous_where_a_kink_passes_a_sample():
    def values(kink: float) -> Tensor:
        curve, _ = bent(torch.tensor(kink, dtype=torch.float64), (1.0, -2.0))
        return torch.stack([curve.maximum()[0], curve.integral()[0], curve.integral(2)[0], *curve.peaks(2)[0]])

    assert_close(values(0.3 - 1e-9), values(0.3 + 1e-9), rtol=0, atol=1e-8)


def on_a_floor(k: Tensor | float = 2e4) -> mbd.System:
    ball = mbd.RigidBody("ball", 1.0, (0.01,) * 3, position=(0.0, 0.0, 0.1))
    floor = mbd.PlaneContact(GROUND.at(), ball.at(), stiffness=k, damping=0.1, name="floor")
    return mbd.System([ball], forces=[floor], gravity=(0.0, 0.0, -G), free=["ball"])


def on_a_stop() -> mbd.System:
    ball = mbd.RigidBody("ball", 1.0, (0.01,) * 3, position=(0.0, 0.0, 0.1))
    stop = mbd.AxialStop(GROUND.at(), ball.at(), axis="z", lower=0.0, stiffness=2e4, name="stop")
    return mbd.System([ball], forces=[stop], gravity=(0.0, 0.0, -G), free=["ball"])


def on_a_gap() -> mbd.System:
    ball = mbd.RigidBody("ball", 1.0, (0.01,) * 3, position=(0.0, 0.0, 0.1))
    stop = mbd.AxialSpringDamper(GROUND.at(), ball.at(), axis="z", law=mbd.forces.Gap(2e4), name="stop")
    return mbd.System([ball], forces=[stop], gravity=(0.0, 0.0, -G), free=["ball"])


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [53, 300])
@pytest.mark.parametrize("build", [on_a_floor, on_a_stop, on_a_gap])
def test_a_falling_body_is_never_pulled_down(build, steps):
    """Between contacts its acceleration is that of gravity: the least one, its peaks, and a range of each contact."""
    motion = mbd.simulate(build(), 0.25, steps=steps, gradients="none").require_ok()
    assert float(mbd.Min(ACCELERATION)(motion)) == pytest.approx(-G, rel=1e-7)
    assert float(mbd.Max(-ACCELERATION)(motion)) == pytest.approx(G, rel=1e-7)
    assert mbd.AtPeaks(-ACCELERATION, count=3)(motion)[0].tolist() == pytest.approx(3 * [G], rel=1e-7)
    assert mbd.AtPeaks(ACCELERATION, count=2)(motion)[0, 1].item() == pytest.approx(-G, rel=1e-7)
    top = float(mbd.Max(ACCELERATION)(motion))
    if "fatigue" in mbd.__all__:  # the extension fatigue is there
        load = mbd.fatigue.EquivalentLoad(ACCELERATION, exponent=3.0, cycles=1.0)
        assert float(load(motion)) == pytest.approx(top + G, rel=1e-6)  # up and down again: one cycle
    for t in torch.linspace(0.0, 0.25, 99, dtype=torch.float64).tolist():
        assert float(mbd.AtTime(ACCELERATION, t)(motion)) >= -G * (1.0 + 1e-7)


@pytest.mark.thorough
def test_lanes_have_kinks_of_their_own():
    """Two lanes, of which one needs smaller steps, are as each alone, and as torch.func.vmap; with gradients."""
    system = on_a_floor(mbd.variable(2e4))
    stiffness = torch.tensor([2e4, 2e3], dtype=torch.float64)
    measures = (mbd.Min(ACCELERATION), mbd.Max(ACCELERATION), mbd.Integral(ACCELERATION**2), mbd.Min(SPEED))

    def values(k: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.2, steps=60, designs={"floor.stiffness": k}, iterations=(8, 6))
        return torch.stack([measure(motion) for measure in measures], 1)

    together = values(stiffness)
    alone = torch.cat([values(k[None]) for k in stiffness])
    assert_close(together, alone, rtol=1e-10, atol=0)
    assert_close(torch.func.vmap(lambda k: values(k[None])[0])(stiffness), alone, rtol=1e-10, atol=0)
    slopes = torch.stack([torch.func.jacrev(lambda k: values(k[None])[0])(k) for k in stiffness])
    expected = torch.stack(
        [(values(k[None] * 1.000001) - values(k[None] / 1.000001))[0] / (2e-6 * k) for k in stiffness]
    )
    assert_close(slopes, expected, rtol=1e-4, atol=1e-9)


def pushed(kind: str, values: list[float]) -> mbd.System:
    """A mass of 2 kg on a slide, with a force that is linear or constant between values."""
    ball = mbd.RigidBody("ball", 2.0, (0.01,) * 3)
    slide = mbd.Prismatic(GROUND.at(), ball.at(), axis="z", name="slide")
    history = mbd.ControlHistory([[u] for u in values], 1.0, kind=kind)
    push = mbd.Controller(history, [mbd.signals.Time()], [mbd.signals.JointForce(slide)], name="push")
    return mbd.System([ball], [slide], [push])


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [20, 53, 400])
@pytest.mark.parametrize("kind", ["linear", "hold"])
def test_accelerations_stay_within_those_of_a_control(kind, steps):
    """Constant pieces at both ends of the range: the least and the largest value, and a cycle of the whole range."""
    values = [1.0, 1.0, -3.0, -3.0, 1.0]
    motion = mbd.simulate(pushed(kind, values), 1.2, steps=steps, gradients="none").require_ok()
    result = [float(measure(ACCELERATION)(motion)) for measure in (mbd.Max, mbd.Min)]
    assert result == pytest.approx([0.5, -1.5], rel=1e-9)
    if "fatigue" in mbd.__all__:
        load = mbd.fatigue.EquivalentLoad(ACCELERATION, exponent=4.0, cycles=1.0)
        assert float(load(motion)) == pytest.approx(2.0, rel=1e-9)
