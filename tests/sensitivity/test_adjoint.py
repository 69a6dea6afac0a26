"""Gradients by going back through a motion: those of forward tangents and of differences, eager and compiled."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from experiments.slider_crank import build
from tests.built_at_once import BuiltAtOnce
from tests.mechanisms import finished, pendulum, spoilt, sprung
from tests.sensitivity.adjoint_cases import CASES
from torchmbd.design.differentiate import differentiate
from torchmbd.integrators import adjoint, compiled, compiled_adjoint, library
from torchmbd.integrators.compiled_adjoint import CompiledSweep
from torchmbd.system import System

TIGHT = {"iterations": (6, 6)}


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


@pytest.fixture
def at_once(built: BuiltAtOnce, monkeypatch: pytest.MonkeyPatch) -> BuiltAtOnce:
    """Compiled code is built when somebody asks for it."""
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    for module in (compiled, compiled_adjoint):
        monkeypatch.setattr(module, "library", built)
    monkeypatch.setattr(compiled_adjoint, "at_hand", lambda dynamics: True)
    return built


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_is_that_of_forward_tangents(name):
    make, duration, steps = CASES[name]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": steps, "sensitivities": names, "designs": designs_of(system, names), **TIGHT}
    forward = finished(mbd.simulate(system, duration, **options))
    back = finished(mbd.simulate(system, duration, adjoint=True, **options))
    wanted, found = (differentiate(everything, motion) for motion in (forward, back))
    assert_close(found.value, wanted.value, rtol=1e-9, atol=0)
    size = wanted.gradient.abs().amax((0, 1))
    assert float(size.min()) > 0
    assert float(((found.gradient - wanted.gradient).abs().amax((0, 1)) / size).max()) < 1e-8
    assert float(back.adjoint.error.max()) < 1e-9


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("laws of forces", "many bodies")]  # long compilations


@pytest.mark.parametrize("name", ["laws of drives", "redundant", "all held", *SLOW])
def test_compiled_and_eager_agree(name, at_once):
    make, duration, steps = CASES[name]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": steps, "sensitivities": names, "designs": designs_of(system, names), "iterations": (4, 2)}
    motion = finished(mbd.simulate(system, duration, adjoint=True, **options))
    fast = differentiate(everything, motion).gradient
    assert "adjoint" in at_once.kinds
    (sweep,) = motion.adjoint._sweeps
    assert isinstance(sweep, CompiledSweep)
    assert sweep.code is not None
    assert float(motion.adjoint.error.max()) < 1e-6
    again = pickle.loads(pickle.dumps(motion))  # without the library
    assert torch.equal(differentiate(everything, again).gradient, fast)
    motion.adjoint._sweeps = [adjoint.Sweep(sweep.grid)]
    eager = differentiate(everything, motion).gradient
    assert float(((fast - eager).abs().amax((0, 1)) / eager.abs().amax((0, 1))).max()) < 1e-8


def test_the_compiled_error_is_the_largest_of_all_steps(at_once):
    """What one correction leaves differs by thousands from step to step; the first step is gone back through last."""
    make, duration, steps = CASES["redundant"]
    system = make()
    names = [name for name, x in system.named_parameters() if x.requires_grad]
    options = {"steps": steps, "sensitivities": names, "designs": designs_of(system, names), "iterations": (4, 1)}
    motion = mbd.simulate(system, duration, adjoint=True, **options).require_ok()
    differentiate(everything, motion)
    (sweep,) = motion.adjoint._sweeps
    assert isinstance(sweep, CompiledSweep)
    compiled_error = motion.adjoint.error.clone()
    motion.adjoint.error.zero_()
    motion.adjoint._sweeps = [adjoint.Sweep(sweep.grid)]
    differentiate(everything, motion)
    assert_close(compiled_error, motion.adjoint.error, rtol=0.1, atol=0)


def test_against_differences_of_the_same_discrete_map(slider_crank):
    """By another way altogether: simulations of neighbors."""
    angles = slider_crank.get_parameter("rod.laminate.angles").detach()
    step = 1e-5
    shifts = step * torch.cat([torch.eye(3, dtype=angles.dtype), -torch.eye(3, dtype=angles.dtype)])
    measure = mbd.Integral(mbd.StrainEnergy("rod"))
    options = {"steps": 40, **TIGHT}
    neighbors = mbd.simulate(slider_crank, 0.004, designs={"rod.laminate.angles": angles + shifts}, **options)
    plus, minus = measure.value(neighbors).chunk(2)
    motion = mbd.simulate(slider_crank, 0.004, sensitivities=True, adjoint=True, **options)
    found = measure.value_and_gradient(motion)[1][0]
    assert_close(found, (plus - minus) / (2 * step), rtol=0, atol=1e-6 * float(found.abs().max()))


@pytest.mark.parametrize("lanes", [1, 11])
def test_lanes_do_not_depend_on_their_company(lanes, at_once):
    """More than a block of them, and less than one."""
    system = build(3, cells=(6, 2), modes=3)
    designs = mbd.deg([[30, -20, 50]]) + torch.linspace(0.0, 0.9, lanes, dtype=torch.float64)[:, None]

    def gradient(some: Tensor) -> Tensor:
        options = {"steps": 30, "sensitivities": True, "designs": {"rod.laminate.angles": some}}
        motion = mbd.simulate(system, 0.002, adjoint=True, **options)
        return mbd.Integral(mbd.StrainEnergy("rod")).value_and_gradient(motion)[1]

    together = gradient(designs)
    for i in (0, lanes - 1):
        alone = gradient(designs[i : i + 1])[0]
        assert_close(together[i], alone, rtol=0, atol=1e-8 * float(alone.abs().max()))


def test_lanes_with_smaller_steps():
    """Lanes that were tried again with half the step are gone back through with it."""
    system = build(3, cells=(6, 2), modes=4)
    designs = {"rod.laminate.angles": mbd.deg([[0, 0, 0], [90, 60, 90]])}
    for steps, kind in ((3, "renewed"), (2, "halved")):
        options = {"steps": steps, "sensitivities": True, "designs": designs, "halvings": int(kind == "halved")}
        forward = finished(mbd.simulate(system, 0.024, **options))
        back = finished(mbd.simulate(system, 0.024, adjoint=True, **options))
        assert back.stats[kind] == forward.stats[kind] == [0, 1]
        wanted, found = (differentiate(everything, motion).gradient for motion in (forward, back))
        assert_close(found, wanted, rtol=0, atol=1e-4 * float(wanted.abs().max()))


@pytest.mark.parametrize("fast", [False, True])
def test_a_lane_that_fails_leaves_the_others_alone(fast, monkeypatch, request):
    if fast:
        request.getfixturevalue("at_once")
    system = build(3, cells=(6, 2), modes=3)
    options = {"steps": 40, "sensitivities": True, "adjoint": True}
    options["designs"] = {"rod.laminate.angles": mbd.deg([[30, -20, 50], [10, 40, -70], [-15, 80, 5]])}
    wanted = differentiate(everything, mbd.simulate(system, 0.002, **options)).gradient

    spoilt(system, monkeypatch)
    motion = mbd.simulate(system, 0.002, **options)
    assert [x == "ok" for x in motion.status] == [True, False, True]
    found = differentiate(everything, motion).gradient
    assert motion.adjoint.error.isnan().tolist() == [False, True, False]
    assert_close(found[[0, 2]], wanted[[0, 2]], rtol=1e-9, atol=0)


def test_many_responses_go_back_in_parts(monkeypatch):
    monkeypatch.setattr("torchmbd.design.differentiate.ROWS", 2)
    system = pendulum()
    motion = mbd.simulate(system, 0.01, steps=5, sensitivities=True, adjoint=True)
    forward = mbd.simulate(system, 0.01, steps=5, sensitivities=True, **TIGHT)
    history = mbd.StrainEnergy("rod")
    wanted, found = (history.series(x).gradient for x in (forward, motion))
    assert found.shape == (1, 6, 2)
    assert_close(found, wanted, rtol=0, atol=1e-6 * float(wanted.abs().max()))


def test_gradients_that_did_not_converge_say_so(monkeypatch):
    motion = mbd.simulate(sprung(), 0.02, steps=15, sensitivities=True, adjoint=True)
    monkeypatch.setattr(adjoint, "MOST", 1)
    monkeypatch.setattr(adjoint, "POOR", 1e-6)
    with pytest.warns(UserWarning, match=r"lane 0: going back .* error of .*; more steps help, or adjoint=False"):
        mbd.Integral(mbd.StrainEnergy("rod")).value_and_gradient(motion)


def test_a_number_that_does_not_depend_on_the_motion():
    motion = mbd.simulate(pendulum(), 0.01, steps=5, sensitivities=True, adjoint=True)
    assert float(mbd.Frequency("rod").value_and_gradient(motion)[1].abs().max()) > 0
    constant = differentiate(lambda m: torch.ones(1, dtype=torch.float64), motion)
    assert constant.gradient.tolist() == [[0.0, 0.0]]


def test_a_variable_that_nothing_depends_on():
    system = pendulum()
    system.register_parameter("loose", torch.nn.Parameter(torch.zeros(2, dtype=torch.float64)))
    motion = mbd.simulate(system, 0.01, steps=5, sensitivities=["loose"], adjoint=True)
    assert differentiate(everything, motion).gradient.tolist() == [[[0.0, 0.0], [0.0, 0.0]]]


def test_what_such_a_motion_does_not_have_is_refused():
    motion = mbd.simulate(pendulum(), 0.01, steps=5, sensitivities=True, adjoint=True)
    for ask in (lambda: motion.dq_db, lambda: motion.da_db, lambda: motion.moved(torch.zeros(2, dtype=torch.float64))):
        with pytest.raises(mbd.InputError, match=r"adjoint=True.*adjoint=False"):
            ask()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "rk4"}, "method is 'rk4'"),
        ({"phases": [mbd.Phase()]}, "phases are given"),
        ({"sensitivities": False}, "names no parameter"),
        ({"adjoint": 1}, "allowed: True, False or None"),
    ],
)
def test_where_there_is_no_way_back_it_is_refused(options, words):
    with pytest.raises(mbd.InputError, match=words):
        mbd.simulate(pendulum(), 0.01, steps=5, **({"sensitivities": True, "adjoint": True} | options))


def energies(count: int, **options) -> mbd.Problem:
    """A problem of three angles and `count` numbers."""
    energy = mbd.StrainEnergy("rod")
    limits = [mbd.Max(energy) <= 1.0, mbd.Final(energy) <= 1.0][: count - 1]
    return mbd.Problem(build(3, cells=(6, 2), modes=3), 0.002, mbd.Integral(energy), limits, steps=20, **options)


def test_a_problem_goes_back_where_that_is_less_work_and_compiled(at_once):
    start = energies(2).start[None]
    assert energies(2).simulate(start, True).adjoint is not None
    assert energies(3).simulate(start, True).adjoint is None  # as many numbers as variables
    assert energies(2).simulate(start).adjoint is None
    assert energies(2, adjoint=False).simulate(start, True).adjoint is None
    assert energies(3, adjoint=True).simulate(start, True).adjoint is not None
    [one], [other] = (energies(2, adjoint=x).evaluate(start, True) for x in (True, False))
    np.testing.assert_allclose(one.objective_gradient, other.objective_gradient, rtol=1e-4)
    np.testing.assert_allclose(one.constraint_gradients, other.constraint_gradients, rtol=1e-4)


def test_a_problem_without_compiled_code_goes_forward():
    assert energies(2).simulate(energies(2).start[None], True).adjoint is None


def test_steps_are_compiled_first(kept, monkeypatch):
    """What goes back through them is not asked for before."""
    monkeypatch.setenv("TORCHMBD_CACHE", str(kept / "empty"))
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    begun = []
    monkeypatch.setattr(library, "build_in_background", lambda dynamics, kind: begun.append(kind))
    monkeypatch.setattr(library, "_seen", {})
    monkeypatch.setattr(library, "_loaded", {})
    for _ in range(3):
        energies(2).simulate(energies(2).start[None], True)
    assert set(begun) == {"step"}
    monkeypatch.setattr(compiled_adjoint, "at_hand", lambda dynamics: True)
    for _ in range(2):
        energies(2).simulate(energies(2).start[None], True)
    assert "adjoint" in begun


def test_a_problem_refuses_a_way_back_that_is_not_there():
    with pytest.raises(mbd.InputError, match="method is 'rk4'"):
        energies(2, adjoint=True, method="rk4")
