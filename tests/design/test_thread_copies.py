"""Groups of designs on threads: the same bits with any number, present numbers, failures, objects of a user in one thread."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

import torchmbd as mbd
from torchmbd.design import thread_copies
from torchmbd.design.thread_copies import design_groups
from torchmbd.errors import warn
from torchmbd.optimization import Evaluation

HEIGHT = mbd.Displacement("bob", "y")
LEAST = 4  # designs of a group, in place of many
DESIGNS = 2 * LEAST


class Twice(mbd.Measure):
    """A measure of a user: twice the height."""

    def value(self, motion: mbd.Trajectory) -> torch.Tensor:
        return 2.0 * mbd.Integral(HEIGHT).value(motion)


def pendulum(minimize: mbd.Measure | None = None, **options) -> mbd.Problem:
    mass, gravity = (torch.nn.Parameter(torch.tensor(x, dtype=torch.float64)) for x in (1.0, [0.0, -9.81, 0.0]))
    bob = mbd.RigidBody("bob", mass, (0.01, 0.01, 0.01), position=(0.6, -0.8, 0.0))
    hinge = mbd.Revolute(mbd.Ground().at(), bob.at(-0.6, 0.8, 0.0), axis="z")
    system = mbd.System([bob], [hinge], gravity=gravity)
    objective = mbd.Integral(HEIGHT) if minimize is None else minimize
    settings = {"steps": 4, "subject_to": mbd.Max(HEIGHT) <= 1.0, "variables": ["bob.mass"], "backend": "eager"}
    return mbd.Problem(system, 0.05, objective, **settings | options)


def arm(**options) -> mbd.Problem:
    energy = mbd.StrainEnergy("arm")
    settings = {
        "steps": 4,
        "subject_to": mbd.Max(energy) <= 1.0,
        "variables": ["arm.laminate.angles"],
        "backend": "eager",
    }
    return mbd.Problem(mbd.examples.arm(), 0.01, mbd.Integral(energy), **settings | options)


def designs(of: mbd.Problem, count: int = DESIGNS) -> np.ndarray:
    return of.start + np.random.default_rng(3).uniform(-0.3, 0.3, (count, len(of.start)))


def evaluated(of: mbd.Problem, X: np.ndarray, threads: int) -> list[Evaluation]:
    with mbd.threads(threads):
        return of.evaluate(X, True)


def assert_same_bits(first: list[Evaluation], second: list[Evaluation]) -> None:
    for x, y in zip(first, second, strict=True):
        assert x.status == y.status
        for name in ("objective", "constraints", "objective_gradient", "constraint_gradients"):
            np.testing.assert_array_equal(getattr(x, name), getattr(y, name))


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch) -> None:
    monkeypatch.setattr(thread_copies, "LEAST", LEAST)


@pytest.fixture
def used(monkeypatch) -> set[int]:
    """Threads that evaluate groups."""
    threads: set[int] = set()
    evaluate = mbd.Problem._evaluate_group

    def noted(self: mbd.Problem, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        threads.add(threading.get_ident())
        if len(threads) == 1:
            threading.Event().wait(0.02)  # so that another thread takes the next group
        return evaluate(self, X, gradients)

    monkeypatch.setattr(mbd.Problem, "_evaluate_group", noted)
    return threads


@pytest.mark.parametrize("lanes", [1, LEAST, DESIGNS - 1, DESIGNS, 100, 500])
def test_groups_keep_the_order_and_follow_from_the_number_of_designs(lanes):
    X = np.arange(2.0 * lanes).reshape(lanes, 2)
    groups = design_groups(X)
    np.testing.assert_array_equal(np.concatenate(groups), X)
    sizes = [len(group) for group in groups]
    assert max(sizes) - min(sizes) <= 1
    assert len(groups) == 1 or min(sizes) >= LEAST


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("model", "options"),
    [(pendulum, {"gradients": "forward"}), (arm, {"gradients": "reverse"}), (arm, {"gradients": "forward"})],
)
def test_threads_share_groups_with_the_same_bits(model, options, used):
    p = model(**options)
    X = designs(p)
    first = evaluated(p, X, 2)  # makes no copies
    assert len(used) == 1
    assert_same_bits(evaluated(p, X, 2), first)
    assert len(used) == 2
    assert_same_bits(evaluated(p, X, 1), first)
    whole = p._evaluate_group(X, True)
    for x, y in zip(first, whole, strict=True):
        assert x.objective == pytest.approx(y.objective, rel=1e-12)
        assert x.objective_gradient == pytest.approx(y.objective_gradient, rel=1e-9)


@pytest.mark.thorough
def test_three_threads_share_three_groups(used):
    p = pendulum()
    X = designs(p, 3 * LEAST)
    first = evaluated(p, X, 1)
    for _ in range(2):
        assert_same_bits(evaluated(p, X, 3), first)
    assert 1 < len(used) <= 3


@pytest.mark.thorough
def test_copies_have_the_present_numbers():
    """A parameter that is not a design variable changes in place, and another tensor takes its place, between evaluations."""
    p = pendulum()
    X = designs(p)
    before = evaluated(p, X, 2)
    evaluated(p, X, 2)
    with torch.no_grad():
        p.system.gravity *= 0.5
    halved = evaluated(p, X, 2)
    assert_same_bits(halved, evaluated(p, X, 1))
    p.system.gravity = torch.nn.Parameter(2.0 * p.system.gravity.detach())
    assert_same_bits(evaluated(p, X, 2), before)
    assert halved[0].objective != pytest.approx(before[0].objective, rel=1e-3)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:design of lane")
def test_a_design_fails_alone():
    p = pendulum()
    X = designs(p)
    evaluated(p, X, 2)
    X[-2] = -1.0
    result = evaluated(p, X, 2)
    assert [k for k, x in enumerate(result) if not x.ok] == [DESIGNS - 2]
    assert_same_bits(result, evaluated(p, X, 1))


@pytest.mark.thorough
def test_objects_of_a_user_serve_in_one_thread(used):
    p = pendulum(Twice())
    X = designs(p)
    for _ in range(2):
        result = evaluated(p, X, 2)
    assert len(used) == 1
    [same] = evaluated(pendulum(), X[:1], 1)
    assert result[0].objective == pytest.approx(2.0 * same.objective, rel=1e-12)


@pytest.mark.thorough
def test_copies_share_tensors_and_last_while_the_problem_is_the_same():
    p = pendulum()
    X = designs(p)
    for _ in range(2):
        evaluated(p, X, 2)
    known = thread_copies._known[p]
    [copy] = known.copies
    originals, copied = (dict(x.system.named_parameters()) for x in (p, copy))
    assert all(copied[name] is x for name, x in originals.items())
    assert not any(x is y for x, y in zip(p.system.modules(), copy.system.modules(), strict=True))
    evaluated(p, X, 2)
    assert thread_copies._known[p] is known


@pytest.mark.thorough
def test_a_motion_is_the_same_each_time_that_it_is_written():
    """Copies of a problem whose motions start at its end last; of other numbers they do not."""
    p = pendulum()
    motion = p.motion(p.start)
    (state, shared), (again, same) = (thread_copies._written(motion) for _ in range(2))
    assert state == again
    assert not all(x is y for x, y in zip(shared, same, strict=True))
    assert thread_copies._are_same(shared, same)
    others = [x.clone() if isinstance(x, torch.Tensor) else x for x in same]
    assert not thread_copies._are_same(shared, others)


@pytest.mark.thorough
def test_an_evaluation_that_breaks_off_gives_its_warnings_and_leaves_no_copy_to_the_next(monkeypatch):
    """A thread may still use its copy after Ctrl-C."""
    p = pendulum()
    X = designs(p)
    for _ in range(2):
        evaluated(p, X, 2)
    assert thread_copies._known[p].copies

    def stopped(self: mbd.Problem, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        warn("before the end")
        raise KeyboardInterrupt

    monkeypatch.setattr(mbd.Problem, "_evaluate_group", stopped)
    with pytest.warns(UserWarning, match="before the end"), pytest.raises(KeyboardInterrupt):
        evaluated(p, X, 2)
    assert p not in thread_copies._known


@pytest.mark.thorough
def test_warnings_of_threads_name_the_line_of_the_user():
    p = arm(variables=["arm.laminate.thickness"])
    X = np.tile(p.start, (DESIGNS, 1))
    evaluated(p, X, 2)
    X[[0, -1]] = 0.6  # [m], thicker than usual
    with pytest.warns(UserWarning, match="design of lane") as caught, mbd.threads(2):
        p.evaluate(X, True)
    files = [warning.filename for warning in caught if "design of lane" in str(warning.message)]
    assert files == 2 * [__file__]
