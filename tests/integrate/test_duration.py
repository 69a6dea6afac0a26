"""The duration of a motion is differentiated by: the steps are as many, their size changes.

Two routes: the gradient in both modes, and Richardson differences of motions of other durations.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, finished, pendulum
from tests.multibody.start.test_initial import four_bar
from tests.refused import refused
from tests.sensitivity.test_law_variables import arm
from torchmbd.examples import slider_crank

STEPS = {"steps": 10, "iterations": (6, 4)}
ANGLES = "rod.laminate.angles"


def pushed() -> mbd.System:
    """Forces and a controller that depend on time."""
    ground, body = mbd.Ground(), box("block")
    force = mbd.Force(body.at(0.1, 0.0, 0.0), lambda t: torch.stack([torch.sin(90.0 * t), 30.0 * t, 0.0 * t]))
    spring = mbd.SpringDamper(
        ground.at(), body.at(), law=lambda s, rate, t: -40.0 * s * torch.cos(50.0 * t), name="soft"
    )
    return mbd.System([body], [mbd.Spherical(ground.at(0.2, 0.1, 0.0), body.at(-0.1, 0.0, 0.0))], [force, spring])


CASES: dict[str, tuple[Callable[[], mbd.System], float]] = {
    "a flexible double pendulum": (pendulum, 0.01),
    "a driven arm": (lambda: arm("sine"), 0.05),
    "a prescribed body": (lambda: slider_crank.build(3, cells=(8, 2), modes=3), 3e-3),
    "redundant constraints": (four_bar, 0.02),
    "forces that depend on time": (pushed, 0.02),
}


def numbers(motion: mbd.Trajectory) -> Tensor:
    """Of everything that a motion has [n]."""
    name = motion.dynamics.topology.names[0]
    body, energies = motion.body(name), motion.energies
    reaction = motion.reaction(motion.system.joints[0].name).force
    parts = [motion.t, motion.q, motion.v, 1e-3 * motion.a, 1e-3 * motion.lam, 1e-3 * reaction, body.r]
    parts += [energies.kinetic, energies.stored, energies.driven]
    measures = [mbd.Integral(mbd.Position(name, "x"))]
    if body.mesh is not None:
        measures += [mbd.Integral(mbd.StrainEnergy(name)), mbd.Max(mbd.StrainEnergy(name))]
    return torch.stack([*((x * (1.0 + x)).sum() for x in parts), *(measure(motion).sum() for measure in measures)])


def differences(f: Callable[[float], Tensor], x: float, share: float = 1e-3) -> Tensor:
    def slope(h: float) -> Tensor:
        return (f(x + h) - f(x - h)) / (2.0 * h)

    with torch.no_grad():
        return (4.0 * slope(share * x) - slope(2.0 * share * x)) / 3.0


@pytest.mark.thorough
@pytest.mark.parametrize("name", CASES)
def test_it_is_the_derivative_of_the_discrete_motion(name):
    build, duration = CASES[name]
    system = build()

    def f(T: Tensor | float) -> Tensor:
        return numbers(finished(mbd.simulate(system, T, **STEPS)))

    T = torch.tensor(duration, dtype=torch.float64)
    # The energy of four rigid links sums up to 269, and changes by 1e-7 per second: smaller differences are its rounding.
    expected = differences(f, duration, 1e-2 if name == "redundant constraints" else 1e-3)
    reverse = torch.func.jacrev(f)(T)
    assert_close(torch.func.jacfwd(f)(T), reverse, rtol=1e-9, atol=1e-12)
    # Differences of accelerations and multipliers have the rounding of the iteration.
    assert_close(reverse, expected, rtol=3e-5, atol=1e-9 * float(expected.abs().max()))
    smooth = [0, 1, 2, 6, 7, 8, 10]
    assert_close(reverse[smooth], expected[smooth], rtol=2e-6, atol=1e-10 * float(expected.abs().max()))


@pytest.mark.thorough
def test_with_designs_in_lanes():
    """One duration for all lanes, each with its own steps; gradients by designs are there as well."""
    system = pendulum()
    designs = mbd.deg([[20.0, -50.0], [10.0, 70.0]]).requires_grad_()
    T = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)

    def f(T: Tensor | float, x: Tensor) -> Tensor:
        motion = mbd.simulate(system, T, designs={ANGLES: x}, **STEPS)
        return (motion.q * (1.0 + motion.q)).sum((1, 2)) + motion.body("rod").strain_energy.sum(1)

    y = f(T, designs)
    rows = torch.stack([torch.autograd.grad(y[k], T, retain_graph=True)[0] for k in range(2)])
    assert_close(rows, differences(lambda t: f(t, designs), 0.01), rtol=2e-6, atol=0)
    both = torch.autograd.grad(y.sum(), (T, designs))
    assert_close(both[0], rows.sum(), rtol=1e-9, atol=0)
    assert_close(both[1], torch.autograd.grad(f(0.01, designs).sum(), designs)[0], rtol=1e-8, atol=0)
    direction = (torch.ones_like(T), torch.full_like(designs, 0.3))
    along = torch.func.jvp(f, (T.detach(), designs.detach()), direction)[1].sum()
    assert_close(along, both[0] + 0.3 * both[1].sum(), rtol=1e-7, atol=0)
    many = torch.vmap(torch.func.jacfwd(lambda x: f(T.detach(), x)[0]))(designs.detach())
    assert_close(many, both[1], rtol=1e-7, atol=0)


@pytest.mark.thorough
def test_a_lane_that_took_half_the_step():
    """By the derivative of the steps that it took."""
    system, stats = pendulum(), {}

    def f(T: Tensor | float) -> Tensor:
        motion = finished(mbd.simulate(system, T, steps=3, iterations=(3, 4)))
        stats.update(motion.stats)
        return motion.q.square().sum()

    T = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    (result,) = torch.autograd.grad(f(T), T)
    assert stats["halved"] == [0]
    assert_close(result, differences(f, 0.3, 1e-4), rtol=1e-5, atol=0)


@pytest.mark.thorough
def test_a_design_of_the_duration():
    """A ball that flies for T seconds: r = v T, by one optimizer of torch."""
    ball = mbd.RigidBody("ball", 1.0, (1.0, 1.0, 1.0), velocity=(2.0, 0.0, 0.0))
    system = mbd.System([ball], free=["ball"])
    T = torch.nn.Parameter(torch.tensor(0.3, dtype=torch.float64))
    optimizer = torch.optim.LBFGS([T], line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        motion = mbd.simulate(system, T, steps=4)
        loss = (motion.body("ball").r[0, -1, 0] - 1.0).square()
        loss.backward()
        assert motion.stats["gradients"] == "reverse"
        assert motion.stats["gradient by the duration"] == "eager"
        return loss

    optimizer.step(closure)
    assert_close(T.detach(), torch.tensor(0.5).double(), rtol=1e-6, atol=0)


@pytest.mark.thorough
def test_compiled_steps(native):
    system = pendulum()
    result = []
    for backend in ("eager", "native"):
        T = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)
        motion = mbd.simulate(system, T, backend=backend, **STEPS)
        result.append(torch.autograd.grad((motion.q * (1.0 + motion.q)).sum(), T)[0])
        assert motion.stats["backend"] == backend
    assert_close(*result, rtol=1e-7, atol=0)


@pytest.mark.thorough
def test_what_is_no_duration_or_would_be_lost_is_refused():
    system = pendulum()
    T = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)
    for options in ({"method": "rk4"}, {"gradients": "forward"}):
        with refused("duration"):
            mbd.simulate(system, T, steps=8, **options)
        assert mbd.simulate(system, T.detach(), steps=8, **(options | {"gradients": "none"})).ok
    with torch.no_grad():
        assert not mbd.simulate(system, T, steps=8).t.requires_grad
    with refused("duration"):
        mbd.simulate(system, torch.tensor(0.01, requires_grad=True), steps=8)
    with refused("duration"):
        mbd.simulate(system, torch.tensor([0.01, 0.02]), steps=8)
    with refused("duration"):
        torch.vmap(lambda t: mbd.simulate(system, t, steps=8).q)(torch.tensor([0.01, 0.02], dtype=torch.float64))
    with refused("duration", -0.01):
        mbd.simulate(system, -T, steps=8)


DEFLECTION = mbd.Displacement("arm", "y", node="right")
HEIGHT = mbd.Position("tool", "y")
OF_TIME = [
    mbd.AtTimes(HEIGHT, count=3),
    mbd.AtTimes(HEIGHT, times=(0.05, 0.1)),
    mbd.AtTime(HEIGHT, 0.07),
    mbd.AtPeaks(DEFLECTION, count=3),
    mbd.Integral(HEIGHT),
    mbd.Integral(mbd.Reaction("hinge", "y"), window=(0.021, 0.0985)),
    # Ends of a window at samples, which move with the duration: no slope depends on the side from which they pass.
    mbd.Integral(mbd.Reaction("hinge", "y"), window=(0.02, 0.1)),
    mbd.RMS(mbd.Reaction("hinge", "y"), window=(0.02, 0.1)),
    mbd.Mean(HEIGHT, window=(0.02, 0.1)),
    mbd.Final(mbd.Velocity("tool", "y"), window=(0.02, 0.1)),
    mbd.AtTime(mbd.Acceleration("tool", "y"), 0.1),
    mbd.Mean(mbd.Velocity("tool", "y")),
    mbd.RMS(mbd.Velocity("tool", "y")),
    mbd.Max(mbd.StrainEnergy("arm")),
    mbd.Min(mbd.Acceleration("tool", "y")),
    mbd.Max(mbd.Angle("arm", "z") * mbd.Reaction("hinge", "y")),
    mbd.SmoothMax(DEFLECTION, scale=1e-3),
    mbd.Final(mbd.Angle("arm", "z")),
]
if "fatigue" in mbd.__all__:  # the extension fatigue is there
    OF_TIME += [
        mbd.fatigue.EquivalentLoad(HEIGHT, exponent=3.0),
        mbd.fatigue.EquivalentLoad(HEIGHT, exponent=3.0, cycles=2.0),
        mbd.fatigue.FatigueDamage("arm", {"22": 3}),
        mbd.fatigue.Damage(mbd.PlyStress("arm", "11", layer=1), curve=mbd.fatigue.SNCurve([(1e2, 1e9), (1e6, 1e5)])),
    ]


@pytest.mark.thorough
def test_every_response_has_its_gradient_by_the_duration(native):
    """Values divided by the duration, and at shares of it, lacked what the division and the times add."""
    system = mbd.examples.arm()

    def values(T: Tensor | float) -> Tensor:
        motion = mbd.simulate(
            system,
            T,
            steps=60,
            iterations=(8, 8),
            gradients="auto" if isinstance(T, Tensor) else "none",
            backend="native",  # by operators of torch the rows take a minute
        )
        return torch.cat([measure(motion).reshape(-1) for measure in OF_TIME])

    T = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    result = values(T)
    slopes = torch.stack([torch.autograd.grad(x, T, retain_graph=True)[0] for x in result])
    coarse, fine = ((values(0.2 + h) - values(0.2 - h)) / (2.0 * h) for h in (2e-5, 1e-5))
    # Of smaller steps rounding shows; second derivatives jump where a sample of a cubic passes the end of a window.
    expected = 2.0 * fine - coarse
    assert_close(slopes, expected, rtol=1e-4, atol=1e-6)
