"""The contract of every integrator in the registry.

It converges to the motion, with phases and without; its tangents are those of its steps and its pullback is their transpose;
a lane that fails is named, alone; options of other names and types are refused.

The mechanism is a spatial double pendulum with a flexible part, two designs.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import pytest
import torch
import torchdiffeq
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import finished, pendulum
from tests.refused import refused
from torchmbd.integrate import METHODS, Trajectory, adjoint_solver
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.ode import ADAPTIVE, FIXED
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.registry import INTEGRATORS, integrator_of
from torchmbd.integrate.retries import integrate_lanes
from torchmbd.integrate.step import Weights
from torchmbd.integrate.stepper import resume
from torchmbd.math.elementwise import reciprocal

pytestmark = pytest.mark.usefixtures("compiled")

DURATION = 0.02


@dataclass(frozen=True)
class Accuracy:
    """How a method is asked to run, and the error that its order allows: largest of q [m, -] and of v [m/s, rad/s]."""

    q: float
    v: float
    steps: int = 40
    options: dict[str, Any] = field(default_factory=dict)


def adaptive(rtol: float, q: float, v: float) -> Accuracy:
    return Accuracy(q, v, steps=1, options={"rtol": rtol, "atol": 1e-2 * rtol})


ACCURACY = {
    "generalized_alpha": Accuracy(1e-6, 1e-4, steps=50),
    "hht_alpha": Accuracy(1e-6, 1e-4, steps=50),
    "euler": Accuracy(2e-4, 2e-2),
    "midpoint": Accuracy(2e-6, 2e-4),
    "heun2": Accuracy(2e-6, 2e-4),
    "heun3": Accuracy(1e-8, 5e-6),
    "rk4": Accuracy(1e-9, 5e-7),
    "explicit_adams": Accuracy(1e-8, 2e-6),
    "implicit_adams": Accuracy(1e-10, 1e-7),
    "fixed_adams": Accuracy(1e-10, 1e-7),
    "adaptive_heun": adaptive(1e-5, 2e-6, 2e-4),
    "fehlberg2": adaptive(1e-6, 2e-5, 1e-3),
    "bosh3": adaptive(1e-7, 1e-6, 1e-4),
    "dopri5": adaptive(1e-7, 1e-8, 1e-6),
    "dopri8": adaptive(1e-8, 1e-9, 1e-6),
}
every_method = pytest.mark.parametrize("method", METHODS)
# The methods of torchdiffeq share their code here: one with fixed steps, an adaptive and an implicit one stand for all.
FIRST = ("generalized_alpha", "hht_alpha", "rk4", "dopri5", "implicit_adams")
others_thorough = pytest.mark.thorough(*(method for method in METHODS if method not in FIRST))


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return pendulum()


@pytest.fixture(scope="module")
def designs() -> dict[str, torch.Tensor]:
    return {"rod.laminate.angles": mbd.deg([[20.0, -50.0], [10.0, 70.0]])}


@pytest.fixture(scope="module")
def reference(system, designs) -> Trajectory:
    return mbd.simulate(system, DURATION, "dopri8", steps=1, designs=designs, rtol=1e-11, atol=1e-12).require_ok()


def test_every_method_is_here():
    assert set(ACCURACY) == set(METHODS)


@pytest.mark.thorough("generalized_alpha", "adaptive_heun", "hht_alpha", "bosh3")
@every_method
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_method_ends_where_the_motion_ends(method, system, designs, reference):
    asked = ACCURACY[method]
    motion = mbd.simulate(system, DURATION, method, steps=asked.steps, designs=designs, **asked.options)
    assert motion.status == ["ok", "ok"]
    assert motion.t.tolist() == pytest.approx([DURATION * i / asked.steps for i in range(asked.steps + 1)])
    assert_close(motion.q[:, 0], reference.q[:, 0], rtol=0, atol=1e-12)
    assert_close(motion.q[:, -1], reference.q[:, -1], rtol=0, atol=asked.q)
    assert_close(motion.v[:, -1], reference.v[:, -1], rtol=0, atol=asked.v)
    # Accelerations of the fastest modes (some 1000 rad/s) are that much less exact; reactions stand between both.
    assert_close(motion.a[:, -1], reference.a[:, -1], rtol=0, atol=1000 * asked.v)
    assert_close(motion.lam[:, -1], reference.lam[:, -1], rtol=0, atol=10 * asked.v)


@pytest.mark.thorough("hht_alpha")
@others_thorough
@every_method
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_a_lane_that_fails_is_named_and_leaves_the_others_alone(method, system, designs):
    """A nan in one design: the other must come out as if it ran alone."""
    asked = ACCURACY[method]
    steps = min(asked.steps, 10)
    # Order and size of the implicit methods' functional iteration depend on all lanes: compare within its tolerance.
    tolerance = 1e-8 if method in ("implicit_adams", "fixed_adams") else 1e-13
    integrator = integrator_of(method, asked.options)
    with torch.no_grad():
        sick = system.dynamics(designs)
        sick.data["Kr"] = sick.data["Kr"].clone()
        sick.data["Kr"][..., 1] = torch.nan
        both = integrate_lanes(integrator, InitialValueProblem.of_dynamics(sick, DURATION), steps)
        healthy = system.dynamics(designs).select_lanes([0])
        alone = integrate_lanes(integrator, InitialValueProblem.of_dynamics(healthy, DURATION), steps)
    history, status = both.history, both.status
    assert alone.status == ["ok"]
    assert status[0] == "ok"
    assert status[1].startswith("failed: ")
    assert_close(history.q[..., :1], alone.history.q, rtol=0, atol=tolerance)
    assert_close(history.v[..., :1], alone.history.v, rtol=0, atol=tolerance)


@pytest.mark.parametrize("method", ["rk4", "heun3", "generalized_alpha"])
def test_a_motion_that_diverges_is_a_status_not_an_exception(method, system):
    """An explicit step beyond the stability limit of one lane overflows; the stable lane of the batch must not end with it."""
    stiff = {"rod.laminate.thickness": torch.tensor([[1.5e-3, 1.5e-3], [0.02, 0.02]], dtype=torch.float64)}
    motion = mbd.simulate(system, 0.5, method, steps=100, designs=stiff)
    assert motion.status[0] == "ok"
    assert torch.isfinite(motion.q[0]).all()
    if method == "generalized_alpha":  # unconditionally stable
        assert motion.ok
        return
    assert "not finite from t = " in motion.status[1]
    assert not motion.ok
    with pytest.raises(mbd.SimulationFailure, match="lane 1: failed: the motion is not finite"):
        motion.require_ok()


ANGLES = "rod.laminate.angles"
WITH_ADJOINT = [name for name, one in INTEGRATORS.items() if one.adjoint]
TIGHT: dict[str, dict[str, Any]] = {name: {"iterations": (6, 6)} for name in WITH_ADJOINT}
# Solved to rounding, tangents are those of the discrete map. Other methods choose steps, or iterate, by all numbers that they
# see: tangents are right within tolerances, and differences of such motions are not smooth.
DISCRETE = {*WITH_ADJOINT, *FIXED} - {"implicit_adams", "fixed_adams"}


def numbers_of(motion: Trajectory) -> torch.Tensor:
    """Coordinates, rates, accelerations and multipliers at all times, of sizes that are alike [lanes, n]."""
    parts = (motion.q, 0.1 * motion.v, 1e-3 * motion.a, 1e-2 * motion.lam)
    return torch.cat([x.flatten(1) for x in parts], 1)


@others_thorough
@every_method
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge", "ignore:the steps do not resolve")
def test_tangents_are_those_of_the_steps(method, system):
    """Against differences of neighbors by the same method; where it is not smooth, by another one."""
    asked, h = ACCURACY[method], 1e-3
    steps, own = min(asked.steps, 10), asked.options | TIGHT.get(method, {})
    b = mbd.deg([[20.0, -50.0]])
    e = torch.tensor([[0.6, -0.8]], dtype=torch.float64)
    motion = mbd.simulate(system, 0.01, method, steps, {ANGLES: b}, gradients="forward", **own)
    other, options = (method, own) if method in DISCRETE else ("dopri8", {"rtol": 1e-10, "atol": 1e-12})
    around = [b + k * h * e for k in (2, 1, -1, -2)]  # one by one: none sees another's steps
    neighbors = [mbd.simulate(system, 0.01, other, steps, {ANGLES: x}, gradients="none", **options) for x in around]
    limit = 1e-7 if method in DISCRETE else 5e-3
    for name, result in (("q", motion.dq_db), ("v", motion.dv_db)):  # rounding hides differences of accelerations
        y = [getattr(neighbor, name)[0] for neighbor in neighbors]
        expected = (8.0 * (y[1] - y[2]) - (y[0] - y[3])) / (12.0 * h)
        assert float(expected.abs().max()) > 1e-3
        assert float((result[0] @ e[0] - expected).abs().max()) < limit * float(expected.abs().max()), name


@pytest.mark.thorough("generalized_alpha")
@every_method
def test_the_pullback_is_the_transpose_of_the_tangents(method, system, designs, reference):
    """Or refused by name, with the methods that have one."""
    if method not in WITH_ADJOINT:
        with refused("gradients"):
            mbd.simulate(system, DURATION, method, steps=2, gradients="reverse")
        return
    level = float(reference.q[0, :, 2].mean())
    for phases in (
        None,
        [mbd.Phase(until=mbd.Event(lambda m: m.q[..., 2] - level)), mbd.Phase(lock=["universal_arm_rod"])],
    ):
        gradients = []
        for way in ("forward", "reverse"):
            b = designs[ANGLES].clone().requires_grad_()
            options = {"gradients": way, "phases": phases, **TIGHT[method]}
            motion = finished(mbd.simulate(system, DURATION, method, 15, {ANGLES: b}, **options))
            x = numbers_of(motion)
            (x * torch.sin(torch.arange(x.shape[1], dtype=x.dtype)) + x * x).sum().backward()
            gradients.append(b.grad)
            assert motion.stats["gradients"] == way
        assert float(gradients[0].abs().min()) > 1e-4
        assert_close(gradients[1], gradients[0], rtol=1e-8, atol=1e-8 * float(gradients[0].abs().max()))


@others_thorough
@every_method
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge", "ignore:the steps do not resolve")
def test_it_goes_through_an_event(method, system, reference):
    """To the same end as a motion without phases: the event changes nothing."""
    asked = ACCURACY[method]
    level = float(reference.q[0, :, 2].mean())
    event = mbd.Event(lambda m: m.q[..., 2] - level)
    steps = max(asked.steps, 4)
    phases = [mbd.Phase(until=event), mbd.Phase()]
    angles = {ANGLES: mbd.deg([[20.0, -50.0]])}
    motion = mbd.simulate(system, DURATION, method, steps, angles, phases=phases, **asked.options).require_ok()
    assert 0.0 < float(motion.switches[0].t[0]) < DURATION
    # An event is looked for step by step: methods of several steps start anew in each.
    assert_close(motion.q[0, -1], reference.q[0, -1], rtol=0, atol=max(1e-6, 30 * asked.q))
    assert_close(motion.v[0, -1], reference.v[0, -1], rtol=0, atol=max(1e-4, 30 * asked.v))


@every_method
def test_options_are_the_fields_of_its_class(method, system):
    """Others are refused by name, with those that there are; and every one of a type that it cannot have."""
    allowed = INTEGRATORS[method].option_types()
    with refused("rest"):
        mbd.simulate(system, DURATION, method, rest=1)
    with refused("name", "mine"):
        integrator_of(method, {"name": "mine"})
    for name in allowed:
        for wrong in ("x", object(), -1, [1.0], {1: 2}, True, b"1", torch.zeros(2)):
            with pytest.raises(mbd.InputError, match=rf"^{name}.* = .*: must be "):
                mbd.simulate(system, DURATION, method, steps=2, **{name: wrong})


OF_TORCHDIFFEQ = {
    "dopri5": [{"first_step": "q"}, {"max_num_steps": 0}, {"max_order": 3}, {"jump_t": [0.1]}, {"rtol": 1e-3}, {3: 1}],
    "rk4": [{"step_size": "x"}, {"step_size": 0.0}, {"interp": "spline"}, {"perturb": 1}, {"first_step": 1e-3}],
    "explicit_adams": [{"max_order": "y"}, {"max_order": 13}, {"implicit": True}, {"max_iters": 0.5}],
}


@pytest.mark.parametrize(("method", "given"), [(m, x) for m, some in OF_TORCHDIFFEQ.items() for x in some])
def test_options_of_torchdiffeq_are_checked(method, given, system):
    """It passes over names that it does not know, and ends in other exceptions on values of a wrong type."""
    (name,) = given
    with pytest.raises(mbd.InputError, match=rf"options of method '{method}': .*{name}.*: must be "):
        mbd.simulate(system, DURATION, method, steps=2, options=given)


def test_every_method_of_torchdiffeq_is_here():
    """The error of an unknown method lists those that the installed version has; SciPy's are not differentiable."""
    with pytest.raises(ValueError, match="Must be one of") as refusal:
        torchdiffeq.odeint(lambda t, y: y, torch.ones(1), torch.tensor([0.0, 1.0]), method="none")
    listed = set(re.findall(r'"(\w+)"', str(refusal.value).partition("Must be one of")[2]))
    assert listed - {"scipy_solver"} == FIXED | ADAPTIVE


def test_good_options_of_torchdiffeq_are_passed_on(system):
    fine = mbd.simulate(system, 0.01, "rk4", steps=2, options={"step_size": 1e-3, "interp": "cubic"}).require_ok()
    steps = mbd.simulate(system, 0.01, "rk4", steps=10).require_ok()
    assert_close(fine.q[:, -1], steps.q[:, -1], rtol=0, atol=1e-14)
    few = {"max_num_steps": 3, "first_step": 1e-6, "max_step": 1e-5}
    assert "max_num_steps" in mbd.simulate(system, 0.01, "dopri5", steps=2, options=few).status[0]


@pytest.mark.parametrize("phases", [object(), int, 1j, torch.zeros(3), True, -1, "x", {}, [], [1], mbd.Phase()])
def test_phases_of_another_type_are_refused(phases, system):
    with refused("phases"):
        mbd.simulate(system, DURATION, steps=2, phases=phases)


@pytest.mark.parametrize("method", [3, None, [3], {"a": 1}, object(), "generalised_alpha", "scipy_solver"])
def test_a_method_that_does_not_exist_is_refused(method, system):
    with refused("method"):
        mbd.simulate(system, DURATION, method)


@dataclass(frozen=True)
class BackwardEuler(OneStep):
    """q1 = q0 o exp(h v1), v1 = v0 + h v1'."""

    name: str = "backward_euler"

    def weights(self, h: Any) -> Weights:
        zero, one = 0.0 * h, 1.0 + 0.0 * h
        return Weights(one, zero, zero, h, zero, h * h, zero, h, h * h, h, reciprocal(h * h))


def test_another_integrator_is_one_line_of_the_registry(system, designs, reference, monkeypatch, native):
    """It has options, gradients in both ways, phases and native code."""
    monkeypatch.setitem(INTEGRATORS, "backward_euler", BackwardEuler())
    ends = [
        mbd.simulate(system, DURATION, "backward_euler", steps, designs, halvings=0).q[:, -1] - reference.q[:, -1]
        for steps in (100, 200)
    ]
    sizes = [float(x.abs().max()) for x in ends]
    assert sizes[0] / sizes[1] == pytest.approx(2.0, abs=0.15)
    gradients = []
    for way in ("forward", "reverse"):
        b = designs[ANGLES].clone().requires_grad_()
        motion = mbd.simulate(system, 0.01, "backward_euler", 15, {ANGLES: b}, gradients=way, iterations=(6, 6))
        numbers_of(motion).sum().backward()
        gradients.append(b.grad)
    assert_close(gradients[1], gradients[0], rtol=1e-8, atol=1e-9 * float(gradients[0].abs().max()))
    fast = mbd.simulate(system, 0.01, "backward_euler", 15, designs, backend="native", iterations=(6, 6))
    assert fast.stats["backend"] == "native"
    assert_close(fast.q, motion.q.detach(), rtol=0, atol=1e-10)
    phases = [mbd.Phase(until=0.0051), mbd.Phase()]
    there = mbd.simulate(system, 0.01, "backward_euler", 15, designs, phases=phases, iterations=(6, 6))
    assert_close(there.q[:, -1], motion.q[:, -1].detach(), rtol=0, atol=1e-4)


def test_hht_and_generalized_alpha_meet(system, designs):
    """am = 0, af = 1/3: the strongest damping of the one is a spectral radius of 1/2 of the other."""
    hht, alpha = (
        mbd.simulate(system, DURATION, method, 20, designs, **options)
        for method, options in (("hht_alpha", {"alpha": -1 / 3}), ("generalized_alpha", {"spectral_radius": 0.5}))
    )
    for name in ("q", "v", "a", "lam"):
        assert_close(getattr(hht, name), getattr(alpha, name), rtol=1e-9, atol=1e-9)


class _Again(NamedTuple):
    """Steps that the adjoint made again: the point of the grid at their start, and positions [times, n_q, 1, lanes]."""

    first: int
    q: torch.Tensor


@pytest.mark.thorough
@pytest.mark.parametrize("method", WITH_ADJOINT)
def test_the_adjoint_makes_the_steps_that_were_made(method, monkeypatch):
    """Through phases and checkpoints: the same states, though two corrections leave much, and so the same slopes.

    Lanes pass the event in different intervals of the grid. Matrices last for 3 steps, checkpoints for 7.
    """
    again: list[_Again] = []

    def resumed(stepper, x, schedule, number, restarts=()):
        last, states = resume(stepper, x, schedule, number, restarts)
        again.append(_Again(number, states.q))
        return last, states

    monkeypatch.setattr(adjoint_solver, "resume", resumed)
    rod = mbd.RigidBody("rod", mbd.variable(1.0), (0.1, 0.08, 0.02), position=(0.5, 0, 0))
    arm = mbd.RigidBody("arm", 0.5, (0.02, 0.03, 0.01), position=(1.2, 0.1, 0))
    joints = [
        mbd.Spherical(mbd.Ground().at(), rod.at(-0.5, 0, 0)),
        mbd.Revolute(rod.at(0.5, 0, 0), arm.at(-0.2, -0.1, 0), axis="y", name="elbow"),
    ]
    system = mbd.System([rod, arm], joints, gravity=(0.3, 0.1, -9.81))
    phases = [mbd.Phase(until=mbd.Event(mbd.Position("rod", "z") + 0.25)), mbd.Phase(lock=["elbow"])]
    slopes = []
    for way in ("forward", "reverse"):
        mass = torch.tensor([1.0, 0.1], dtype=torch.float64, requires_grad=True)
        options = {"iterations": (2, 8), "refresh": 3, "halvings": 0, "checkpoint": 7, "backend": "eager"}
        designs, steps = {"rod.mass": mass}, {"gradients": way, "phases": phases, "steps": 42}
        motion = finished(mbd.simulate(system, 0.5, method, designs=designs, **steps, **options))
        x = numbers_of(motion)
        (x * torch.sin(torch.arange(x.shape[1], dtype=x.dtype))).sum().backward()
        slopes.append(mass.grad)
    passed = [int(t / 0.5 * 42) for t in motion.switches[0].t.tolist()]
    assert passed[0] // 7 != passed[1] // 7
    assert {part.first % 7 for part in again} > {0}  # also from the first point after the switch
    for part in again:  # of one lane
        states = part.q[-part.first % 7 :: 7, :, 0, 0]  # at the times that are kept
        recorded = motion.q.detach()[:, -(-part.first // 7) :][:, : len(states)]
        assert not len(states) or float((states - recorded).abs().amax((1, 2)).min()) < 1e-15
    assert_close(slopes[1], slopes[0], rtol=1e-8, atol=0)
