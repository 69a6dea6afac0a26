"""The transient problem as optimizers see it: arrays, normalized constraints, failed evaluations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import ANY, refused
from torchmbd.design import Constraint
from torchmbd.errors import InputError
from torchmbd.fem.reduction import CutCluster
from torchmbd.fem.reduction.forms import lane_name

pytestmark = pytest.mark.usefixtures("compiled")

ENERGY = mbd.StrainEnergy("rod")


def problem(**given) -> mbd.Problem:
    asked = {
        "duration": 0.03,
        "minimize": mbd.Integral(ENERGY),
        "subject_to": [mbd.Max(ENERGY) <= "initial", mbd.Max(ENERGY) <= 1e-5],
        "bounds": mbd.deg([-90, 90]),
        "steps": 30,
        "iterations": (6, 6),
        "refresh": 1,
    }
    return mbd.Problem(**({"system": pendulum()} | asked | given))


def thick(**given) -> mbd.Problem:
    """Over the thickness, by an explicit method that overflows where the rod is thick."""
    limited = [mbd.Max(ENERGY) <= "initial"]
    names = ["rod.laminate.thickness"]
    return mbd.Problem(
        pendulum(), 0.5, mbd.Integral(ENERGY), limited, (1e-4, 1.0), names, method="rk4", steps=100, **given
    )


@pytest.fixture(scope="module")
def shared() -> mbd.Problem:
    return problem()


@pytest.mark.thorough
def test_values_are_those_of_the_responses(shared):
    """Constraints as (g - c)/|c|: zero at the start for "initial", of order one for a number."""
    X = np.radians([[20.0, -50.0], [70.0, 15.0]])
    result = shared.evaluate(X, gradients=False)
    motion = shared.simulate(X)
    integral, peak = mbd.Integral(ENERGY).value(motion).tolist(), mbd.Max(ENERGY).value(motion).tolist()
    assert [e.status for e in result] == ["ok", "ok"]
    assert [e.objective for e in result] == pytest.approx(integral)
    assert result[0].constraints == pytest.approx([0.0, (peak[0] - 1e-5) / 1e-5], abs=1e-12)
    assert result[1].constraints == pytest.approx([peak[1] / peak[0] - 1.0, (peak[1] - 1e-5) / 1e-5], rel=1e-9)
    assert result[0].objective_gradient is None
    assert shared.limits == pytest.approx([peak[0], 1e-5])


@pytest.mark.thorough
def test_gradients_belong_to_the_values(shared):
    x, h = np.radians([20.0, -50.0]), 1e-5
    (result,) = shared.evaluate(x[None], gradients=True)
    neighbors = shared.evaluate(np.concatenate([x + h * np.eye(2), x - h * np.eye(2)]), gradients=False)
    rows = np.array([[e.objective, *e.constraints] for e in neighbors])
    slopes = ((rows[:2] - rows[2:]) / (2 * h)).T
    scale = np.abs(slopes).max(1)
    assert result.objective_gradient == pytest.approx(slopes[0], abs=1e-5 * scale[0])
    assert result.constraint_gradients.shape == (2, 2)
    for row, slope, size in zip(result.constraint_gradients, slopes[1:], scale[1:], strict=True):
        assert row == pytest.approx(slope, abs=1e-5 * size)


@pytest.mark.thorough
def test_the_system_keeps_its_own_design(shared):
    before = [x.detach().clone() for x in shared.system.parameters()]
    shared.evaluate(np.radians([[1.0, 2.0]]), gradients=True)
    assert all((x == y).all() for x, y in zip(before, shared.system.parameters(), strict=True))


@pytest.mark.thorough
def test_a_design_that_fails_is_a_failed_evaluation_and_leaves_the_others():
    asked = thick()
    good, bad = asked.evaluate(np.array([[1.5e-3, 1.5e-3], [0.02, 0.02]]), gradients=False)
    assert good.ok
    assert math.isfinite(good.objective)
    assert bad.status.startswith("failed: ")
    assert math.isnan(bad.objective)
    assert np.isnan(bad.constraints).all()
    assert bad.constraints.shape == (1,)


@pytest.mark.thorough
def test_a_design_that_is_no_laminate_is_a_failed_evaluation_and_leaves_the_others(shared):
    result = shared.evaluate(np.array([[0.3, -0.5], [np.nan, 0.2]]), gradients=False)
    assert result[0].ok
    assert result[1].status.startswith("failed: ")
    assert result[0].objective == pytest.approx(shared.evaluate(np.array([[0.3, -0.5]]), gradients=False)[0].objective)


@pytest.mark.thorough
def test_an_initial_limit_needs_an_initial_motion():
    asked = thick(start=0.02)
    with pytest.raises(mbd.SimulationFailure, match="lane 0: failed: the motion is not finite"):
        _ = asked.limits


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"minimize": ENERGY}, ["minimize = ", "StrainEnergy", "a measure, such as Integral"]),
        ({"system": None}, ["system = None", "a System"]),
        ({"subject_to": [mbd.Max(ENERGY)]}, ["subject_to has", "Max", "constraints, such as Max"]),
        ({"subject_to": "initial"}, ["subject_to = 'initial'", "a list of constraints, such as Max"]),
        ({"duration": 0.0}, ["duration", "0.0", "positive"]),
        ({"duration": math.nan}, ["duration", "nan", "positive"]),
        ({"method": "dopri"}, ["method = 'dopri'", "Try: 'dopri"]),
        ({"steps": 0}, ["steps", "0", "positive integer"]),
        ({"rtol": 1e-6}, ["rtol = 1e-06 is not an option", "spectral_radius"]),
        ({"minimize": mbd.Integral(mbd.StrainEnergy("rdo"))}, ["'rdo'", "Try: 'rod'"]),
        ({"subject_to": [mbd.Max(mbd.StrainEnergy("arm")) <= 1.0]}, ["'arm' is rigid", "must be rod"]),
        ({"variables": ["rod.angles"]}, ["'rod.angles'", "Try:"]),
        ({"bounds": (1.0, 0.0)}, ["lower bound of", "must be below upper"]),
    ],
    ids=lambda x: "-".join(f"{k}={v}" for k, v in x.items())[:40] if isinstance(x, dict) else "",
)
def test_bad_input_is_refused_at_the_door(given, words):
    """When the problem is made, not hours later as evaluations that all failed."""
    with pytest.raises(InputError) as error:
        problem(**given)
    assert error.value.allowed or error.value.hint
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("X", [np.zeros(2), np.zeros((2, 3)), [[1.0]], "x", [[1.0], [1.0, 2.0]]])
def test_designs_of_another_shape_are_named(shared, X):
    for call in (lambda: shared.evaluate(X, False), lambda: shared.simulate(X)):
        with refused("designs"):
            call()


@pytest.mark.thorough
def test_bounds_may_hold_a_variable():
    start = float(problem().start[1])
    asked = problem(bounds=([-1.0, start], [1.0, start]), subject_to=())
    result = mbd.optimize(asked, "slsqp", max_iterations=2)
    assert result.status in ("converged", "max_iterations")
    assert result.x[1] == start != result.x[0]


def test_a_single_constraint_needs_no_list():
    limit = mbd.Max(ENERGY) <= 1.0
    assert problem(subject_to=limit).constraints == [limit]


@pytest.mark.parametrize("limit", ["start", math.inf, math.nan, True])
def test_limits_of_constraints(limit):
    with refused("limit"):
        _ = mbd.Max(ENERGY) <= limit
    with refused("measure"):
        Constraint(ENERGY, 1.0)


@pytest.mark.thorough
def test_a_problem_may_have_phases():
    """A joint is locked on the way: the gradient is that of the motion through both phases."""
    lock = [mbd.Phase(until=0.0105), mbd.Phase(lock=["universal_arm_rod"])]
    result, h = problem(phases=lock, subject_to=[]), 1e-4
    x = np.radians([20.0, -50.0])
    step = np.array([h, 0.0])
    neighbors = np.array([x, x + step, x - step])
    middle, up, down = result.evaluate(neighbors, gradients=True)
    assert middle.objective_gradient is not None
    assert middle.objective_gradient[0] == pytest.approx((up.objective - down.objective) / (2.0 * h), rel=1e-5)
    assert middle.objective != pytest.approx(
        problem(subject_to=[]).evaluate(x[None], gradients=False)[0].objective, rel=0.01
    )
    forward = problem(phases=lock, subject_to=[], gradients="forward")
    assert (result.gradients, forward.gradients) == ("reverse", "forward")  # one response by two angles
    expected = forward.evaluate(x[None], gradients=True)[0].objective_gradient
    assert middle.objective_gradient == pytest.approx(expected, rel=1e-8)
    many = [limit for _ in range(4) for limit in (mbd.Max(ENERGY) <= 1.0, mbd.Min(ENERGY) >= 0.0)]
    assert problem(phases=lock, subject_to=many[:2]).gradients == "reverse"  # few responses by fewer angles
    assert problem(phases=lock, subject_to=many).gradients == "forward"
    with refused("phases.1.lock", "hook"):
        problem(phases=[mbd.Phase(lock=["hook"])])


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["forward", "reverse"])
def test_numpy_in_a_response_is_named(gradients):
    @mbd.measure
    def largest(motion):
        return torch.as_tensor(motion.body("arm").strain_energy.numpy().max(1))

    p = mbd.Problem(mbd.examples.arm(), 0.01, largest, steps=4, gradients=gradients)
    with refused("response.largest", ANY, "NumPy", "torch.maximum"):
        p.evaluate(p.start[None], True)


@pytest.mark.thorough
def test_the_status_of_a_design_names_no_lane(monkeypatch):
    """A batch of which a design cannot be reduced is evaluated without it, and the status is that of the design alone."""
    part = problem()
    motions = part._motions

    def refusing(X, gradients, **options):
        cut = tuple(np.flatnonzero(X[:, 0] > 1.0).tolist())
        if cut:
            shown = f"2{lane_name(cut[0], len(X))}"
            raise CutCluster(("modes",), 2, "must not divide modes", "", cut, 3, shown)
        return motions(X, gradients, **options)

    monkeypatch.setattr(part, "_motions", refusing)
    X = np.radians([[20.0, -50.0], [70.0, 15.0], [30.0, 10.0], [80.0, 15.0]])
    states = [e.status for e in part.evaluate(X, False)]
    assert states == ["ok", "failed: modes = 2: must not divide modes"] * 2
