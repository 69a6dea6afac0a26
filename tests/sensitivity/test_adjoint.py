"""Gradients by the adjoint: those of forward tangents and of differences, eager and compiled."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, box, finished, pendulum, spoilt, sprung
from tests.refused import refused, warned
from tests.sensitivity.adjoint_cases import CASES
from torchmbd.design.differentiate import differentiate
from torchmbd.examples.slider_crank import build
from torchmbd.integrate import adjoint, adjoint_solver, pullback
from torchmbd.integrate.phases.adjoint import RunAdjoint
from torchmbd.multibody.system import System
from torchmbd.results import history

GROUND = mbd.Ground()
TIGHT = {"iterations": (6, 6)}
WAYS = ("forward", "reverse")


def designs_of(system: System, names: list[str]) -> dict[str, Tensor]:
    """Two designs apart from each other."""
    make = torch.Generator().manual_seed(2)
    own = {name: system.get_parameter(name).detach() for name in names}
    return {n: x + torch.rand(2, *x.shape, generator=make, dtype=x.dtype) * 0.1 * x.abs() for n, x in own.items()}


def everything(motion: mbd.Trajectory) -> Tensor:
    """Numbers of a motion that depend on all of it [lanes, 2]: on states between and at the ends, and on the model."""
    parts = [motion.q, 0.1 * motion.v, 1e-3 * motion.a, 1e-3 * motion.lam]
    weights = [torch.sin(torch.arange(x[0].numel(), dtype=x.dtype)).reshape(x.shape[1:]) for x in parts]
    total = sum((w * x + w * w * x * x).flatten(1).sum(1) for w, x in zip(weights, parts, strict=True))
    return torch.stack([total, motion.q[:, -1].square().sum(1)], 1)


def the_adjoint(motion: mbd.Trajectory) -> RunAdjoint:
    """The adjoint of the only run of a motion, after one call for gradients."""
    ((run,),) = motion.integration.adjoint._runs.values()
    return run.adjoint


@pytest.mark.thorough
@pytest.mark.parametrize(  # "kink" is the mechanism of "forces" with a law of its own
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "forces" else []) for name in CASES]
)
def test_the_gradient_is_that_of_forward_tangents(name):
    make, duration, steps = CASES[name]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": steps, "variables": names, "designs": designs_of(system, names), **TIGHT}
    forward, back = (finished(mbd.simulate(system, duration, gradients=way, **options)) for way in WAYS)
    expected, result = (differentiate(everything, motion) for motion in (forward, back))
    assert_close(result.value, expected.value, rtol=1e-9, atol=0)
    size = expected.gradient.abs().amax((0, 1))
    assert float(size.min()) > 0
    assert float(((result.gradient - expected.gradient).abs().amax((0, 1)) / size).max()) < 1e-8
    assert float(back.integration.adjoint.error.max()) < pullback.ENOUGH


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("laws of forces", "many bodies")]  # long compilations


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["laws of drives", "redundant", "all held", *SLOW])
def test_compiled_and_eager_agree(name, native):
    make, duration, steps = CASES[name]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": steps, "variables": names, "designs": designs_of(system, names), "iterations": (4, 2)}
    motion = finished(mbd.simulate(system, duration, gradients="reverse", backend="native", **options))
    fast = differentiate(everything, motion).gradient
    adjoint = the_adjoint(motion)
    ((inputs, solver),) = adjoint.solvers.items()
    assert type(solver) is not adjoint_solver.AdjointSolver
    assert solver.code is not None
    assert float(adjoint.error.max()) < 1e-6
    adjoint.solvers[inputs] = adjoint_solver.AdjointSolver(solver.grid)
    eager = differentiate(everything, motion).gradient
    assert float(((fast - eager).abs().amax((0, 1)) / eager.abs().amax((0, 1))).max()) < 1e-8


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["eager", "native"])
def test_segments_change_nothing(backend, native, monkeypatch):
    """The algorithmic acceleration at the start of a segment, the cotangents at its end, and laws of the design."""
    make, duration, steps = CASES["laws of drives"]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": steps, "variables": names, "designs": designs_of(system, names), "iterations": (4, 2)}
    result = []
    for length in (history.SEGMENT, 7):
        monkeypatch.setattr(history, "SEGMENT", length)
        motion = finished(mbd.simulate(system, duration, gradients="reverse", backend=backend, **options))
        result.append(differentiate(everything, motion).gradient)
    assert_close(result[1], result[0], rtol=1e-11, atol=1e-13 * float(result[0].abs().max()))


@pytest.mark.thorough
def test_laws_of_the_design_over_many_segments(monkeypatch):
    """Segments go back from the last one: what drives prescribe is put together in order of time."""
    hub, bob = mbd.RigidBody("hub", 1.0, (1e-3, 1e-3, 1e-3)), box("bob", position=(0.2, 0.0, 0.0))
    motor = mbd.Drive(GROUND.at(), hub, angle=mbd.Sine(mbd.variable(0.3), mbd.variable(4.0)), name="motor")
    joints = [mbd.Revolute(GROUND.at(), hub.at()), motor, mbd.Spherical(hub.at(0.2, 0.0, 0.0), bob.at())]
    system = mbd.System([hub, bob], joints, gravity=GRAVITY)
    names = [name for name, _ in system.named_parameters()]
    assert names == ["motor.amplitude", "motor.frequency"]
    monkeypatch.setattr(history, "SEGMENT", 2)
    forward, back = (
        finished(mbd.simulate(system, 0.05, steps=5, gradients=way, variables=names, backend="eager", **TIGHT))
        for way in WAYS
    )
    expected, result = (differentiate(everything, motion).gradient for motion in (forward, back))
    assert_close(result, expected, rtol=1e-8, atol=1e-8 * float(expected.abs().max()))


@pytest.mark.thorough
def test_the_compiled_error_is_the_largest_of_all_steps(native):
    """What one correction leaves differs by thousands from step to step; the adjoint comes to the first step last."""
    make, duration, steps = CASES["redundant"]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": steps, "variables": names, "designs": designs_of(system, names), "iterations": (4, 1)}
    motion = finished(mbd.simulate(system, duration, gradients="reverse", backend="native", **options))
    differentiate(everything, motion)
    adjoint = the_adjoint(motion)
    ((inputs, solver),) = adjoint.solvers.items()
    assert type(solver) is not adjoint_solver.AdjointSolver
    compiled_error = adjoint.error.clone()
    adjoint.error.zero_()
    adjoint.solvers[inputs] = adjoint_solver.AdjointSolver(solver.grid)
    differentiate(everything, motion)
    assert_close(compiled_error, adjoint.error, rtol=0.1, atol=0)


@pytest.mark.thorough
def test_against_differences_of_the_same_discrete_map(slider_crank):
    """By another way altogether: simulations of neighbors."""
    angles = slider_crank.get_parameter("rod.laminate.angles").detach()
    step = 1e-5
    shifts = step * torch.cat([torch.eye(3, dtype=angles.dtype), -torch.eye(3, dtype=angles.dtype)])
    measure = mbd.Integral(mbd.StrainEnergy("rod"))
    options = {"steps": 40, **TIGHT}
    neighbors = mbd.simulate(slider_crank, 0.004, designs={"rod.laminate.angles": angles + shifts}, **options)
    plus, minus = measure.value(neighbors).chunk(2)
    motion = mbd.simulate(slider_crank, 0.004, gradients="reverse", **options)
    result = measure.value_and_gradient(motion)[1][0]
    assert_close(result, (plus - minus) / (2 * step), rtol=0, atol=1e-6 * float(result.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("lanes", [1, 11])
def test_lanes_do_not_depend_on_each_other(lanes, native):
    """More than a block of them, and less than one."""
    system = build(3, cells=(6, 2), modes=3)
    designs = mbd.deg([[30, -20, 50]]) + torch.linspace(0.0, 0.9, lanes, dtype=torch.float64)[:, None]

    def gradient(some: Tensor) -> Tensor:
        options = {"steps": 30, "gradients": "reverse", "backend": "native", "designs": {"rod.laminate.angles": some}}
        motion = mbd.simulate(system, 0.002, **options)
        return mbd.Integral(mbd.StrainEnergy("rod")).value_and_gradient(motion)[1]

    together = gradient(designs)
    for i in (0, lanes - 1):
        alone = gradient(designs[i : i + 1])[0]
        assert_close(together[i], alone, rtol=0, atol=1e-8 * float(alone.abs().max()))


@pytest.mark.thorough
def test_lanes_with_smaller_steps():
    """The adjoint of lanes that were tried again with half the step takes these steps."""
    system = build(3, cells=(6, 2), modes=4)
    designs = {"rod.laminate.angles": mbd.deg([[0, 0, 0], [90, 60, 90]])}
    for steps, again in ((3, []), (2, [0, 1])):
        options = {"steps": steps, "designs": designs}
        forward, back = (finished(mbd.simulate(system, 0.024, gradients=way, **options)) for way in WAYS)
        assert back.stats.get("halved", []) == forward.stats.get("halved", []) == again
        expected, result = (differentiate(everything, motion).gradient for motion in (forward, back))
        assert_close(result, expected, rtol=0, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("fast", [False, True])
def test_a_lane_that_fails_leaves_the_others_alone(fast, monkeypatch, request):
    if fast:
        request.getfixturevalue("native")
    system = build(3, cells=(6, 2), modes=3)
    options = {"steps": 10, "gradients": "reverse", "backend": "native" if fast else "eager"}
    options["designs"] = {"rod.laminate.angles": mbd.deg([[30, -20, 50], [10, 40, -70], [-15, 80, 5]])}
    expected = differentiate(everything, mbd.simulate(system, 5e-4, **options)).gradient

    spoilt(system, monkeypatch)
    motion = mbd.simulate(system, 5e-4, **options)
    assert [x == "ok" for x in motion.status] == [True, False, True]
    result = differentiate(everything, motion).gradient
    assert torch.isnan(result[1]).all()  # a lane without values has no gradients: not 0
    assert_close(result[[0, 2]], expected[[0, 2]], rtol=1e-9, atol=0)


@pytest.mark.thorough
def test_many_responses_go_back_in_parts(monkeypatch):
    monkeypatch.setattr("torchmbd.design.differentiate.ROWS", 2)
    system = pendulum()
    motion = mbd.simulate(system, 0.01, steps=5, gradients="reverse")
    forward = mbd.simulate(system, 0.01, steps=5, gradients="forward", **TIGHT)
    history = mbd.StrainEnergy("rod")
    expected, result = (history.series(x).gradient for x in (forward, motion))
    assert result.shape == (1, 6, 2)
    assert_close(result, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.thorough
def test_gradients_that_did_not_converge_say_so(monkeypatch):
    motion = mbd.simulate(sprung(), 0.02, steps=15, gradients="reverse")
    monkeypatch.setattr(pullback, "MOST", 1)
    monkeypatch.setattr(adjoint, "INACCURATE", 1e-6)
    with warned("lane 0", "adjoint", "gradients='forward'"):
        mbd.Integral(mbd.StrainEnergy("rod")).value_and_gradient(motion)


@pytest.mark.thorough
def test_a_number_that_does_not_depend_on_the_motion():
    motion = mbd.simulate(pendulum(), 0.01, steps=5, gradients="reverse")
    assert float(mbd.Frequency("rod").value_and_gradient(motion)[1].abs().max()) > 0
    constant = differentiate(lambda m: torch.ones(1, dtype=torch.float64), motion)
    assert constant.gradient.tolist() == [[0.0, 0.0]]


@pytest.mark.thorough
def test_a_variable_that_nothing_depends_on():
    system = pendulum()
    system.register_parameter("loose", torch.nn.Parameter(torch.zeros(2, dtype=torch.float64)))
    motion = mbd.simulate(system, 0.01, steps=5, gradients="reverse", variables=["loose"])
    assert differentiate(everything, motion).gradient.tolist() == [[[0.0, 0.0], [0.0, 0.0]]]


def energies(count: int, **options) -> mbd.Problem:
    """A problem of three angles and `count` numbers."""
    energy = mbd.StrainEnergy("rod")
    limits = [mbd.Max(energy) <= 1.0, mbd.Final(energy) <= 1.0][: count - 1]
    return mbd.Problem(build(3, cells=(6, 2), modes=3), 0.002, mbd.Integral(energy), limits, steps=20, **options)


@pytest.mark.thorough
def test_a_problem_takes_the_adjoint_where_that_is_less_work(compiled):
    assert energies(2).gradients == "reverse"
    assert energies(3).gradients == "reverse"  # as many numbers as variables
    assert energies(2, method="rk4").gradients == "forward"
    assert energies(2, gradients="forward").gradients == "forward"
    start = energies(2).start[None]
    assert energies(2).simulate(start, True).stats["gradients"] == "reverse"
    assert energies(2).simulate(start).stats["gradients"] == "none"
    [one], [other] = (energies(2, gradients=x).evaluate(start, True) for x in WAYS)
    np.testing.assert_allclose(one.objective_gradient, other.objective_gradient, rtol=1e-4)
    np.testing.assert_allclose(one.constraint_gradients, other.constraint_gradients, rtol=1e-4)


def test_a_problem_refuses_an_adjoint_that_is_not_there():
    with refused("gradients"):
        energies(2, gradients="reverse", method="rk4")


@pytest.mark.thorough
@pytest.mark.parametrize(("length", "backend"), [(2000, "native"), (15, "eager")])
def test_states_between_checkpoints_are_made_again(backend, length, native, monkeypatch):
    """Values are those of all steps at the kept times, to the bit; so are gradients of what these times have."""
    monkeypatch.setattr(history, "SEGMENT", length)
    make, duration, _ = CASES["laws of drives"]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": 40, "designs": designs_of(system, names), "backend": backend, "iterations": (4, 2)}

    def kept(motion: mbd.Trajectory) -> Tensor:
        every = (len(motion.t) - 1) // 8
        return torch.stack([(motion.q[:, ::every] ** 2).sum((1, 2)), 1e-3 * motion.lam[:, ::every].sum((1, 2))], 1)

    every, thinned = (
        mbd.simulate(system, duration, gradients="reverse", variables=names, checkpoint=k, **options) for k in (1, 5)
    )
    assert_close(thinned.t, every.t[::5], rtol=1e-14, atol=0)
    assert_close(thinned.q, every.q[:, ::5], rtol=1e-9, atol=1e-12)
    expected, result = (differentiate(kept, finished(motion)).gradient for motion in (every, thinned))
    assert_close(result, expected, rtol=1e-7, atol=1e-9 * float(expected.abs().max()))
    forward = mbd.simulate(system, duration, gradients="forward", variables=names, checkpoint=5, **options)
    assert_close(differentiate(kept, forward).gradient, expected, rtol=1e-6, atol=1e-8 * float(expected.abs().max()))


@pytest.mark.thorough
def test_steps_with_further_corrections_are_made_again_as_they_were(native):
    """Lanes of which the quick iteration is imprecise, between checkpoints."""
    system = build(3, cells=(6, 2), modes=3)
    angles = system.get_parameter("rod.laminate.angles").detach()
    designs = {"rod.laminate.angles": torch.stack([angles, angles + 0.3])}
    measure = mbd.Integral(mbd.StrainEnergy("rod"))
    result = []
    for integrator in ({"iterations": (1, 1), "refresh": 7}, {"iterations": (6, 6), "refresh": 0}):
        motion = mbd.simulate(
            system, 0.01, steps=40, checkpoint=4, designs=designs, gradients="reverse", backend="native", **integrator
        )
        result.append((motion.stats["further_corrections"], measure.value_and_gradient(finished(motion))))
    (again, quick), (_, careful) = result
    assert float(again.min()) > 0.0
    for one, other in zip(quick, careful, strict=True):
        assert_close(one, other, rtol=1e-5, atol=1e-7 * float(other.abs().max()))
