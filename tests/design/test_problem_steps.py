"""Steps that a problem chooses by the errors of its responses."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused, warned
from torchmbd.design import problem_steps
from torchmbd.design.problem_steps import steps_for
from torchmbd.progress import stages_told

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture(autouse=True)
def no_earlier_problems(monkeypatch):
    """Problems of other tests, whose errors are known, are not equal to those of this one."""
    monkeypatch.setattr(problem_steps, "_of_equal_problems", OrderedDict())


@pytest.fixture
def simulated(monkeypatch) -> list[int]:
    """The steps of every motion from now on."""
    steps, simulate = [], mbd.Simulation.__call__

    def call(*args, **options):
        motion = simulate(*args, **options)
        steps.append(motion.repetition.steps)
        return motion

    monkeypatch.setattr(mbd.Simulation, "__call__", call)
    return steps


def mass_on_a_spring(stiffness: float = 4.0e3, mass: float = 1.0) -> mbd.System:
    """Pushed at the start: x = v0 / om sin(om t)."""
    bob = mbd.RigidBody("bob", mbd.variable(mass), (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    ground = mbd.Ground()
    spring = mbd.SpringDamper(ground.at(-1.0, 0.0, 0.0), bob.at(), stiffness=stiffness, rest=1.0)
    return mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])


def problem(measure: mbd.Measure | None = None, duration: float = 1.0, **options) -> mbd.Problem:
    measure = mbd.Final(mbd.Position("bob", "x")) if measure is None else measure
    given = {"variables": ["bob.mass"], "bounds": (0.5, 2.0)} | options
    return mbd.Problem(mass_on_a_spring(), duration, measure, **given)


def exact(duration: float = 1.0, mass: float = 1.0) -> float:
    omega = math.sqrt(4.0e3 / mass)
    return math.sin(omega * duration) / omega


@pytest.mark.thorough
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_chosen_steps_have_the_error_that_was_asked_for(tolerance):
    """In closed form, a share of the range of the vibration; and a quarter of the steps would not do."""
    chosen, size = problem(tolerance=tolerance), 2.0 / math.sqrt(4.0e3)
    value = chosen.objective(chosen.motion(chosen.start)).item()
    assert abs(value - exact()) <= 1.1 * tolerance * size
    quarter = (chosen.steps or 0) // 4
    few = problem(steps=quarter)
    off = abs(few.objective(few.motion(few.start)).item() - exact())
    assert quarter < 250 or off > tolerance * size


@pytest.mark.thorough
def test_a_small_difference_asks_for_more_steps_than_its_parts():
    """Quantities with a natural zero are measured by their value."""
    final, rms = mbd.Final(mbd.Velocity("bob", "x")), mbd.RMS(mbd.Velocity("bob", "x"))
    whole = problem(final, tolerance=4e-3)
    motion = whole.motion(whole.start)
    share = 0.9 * (final(motion) / rms(motion)).item()
    small = problem(final - share * rms, tolerance=4e-3)
    assert (small.steps or 0) > 2 * (whole.steps or 0)  # a tenth of the value: sqrt(10) times


@pytest.mark.thorough
def test_neither_a_constant_nor_a_unit_changes_the_steps():
    final = mbd.Final(mbd.Position("bob", "x"))
    changes = {"plain": (1.0, 0.0), "constant": (1.0, 1000.0), "micrometers": (1e6, 0.0), "both": (1e-3, -7.0)}
    steps = set()
    for factor, constant in changes.values():
        limits = [factor * final + constant <= factor * 0.01 + constant]
        steps.add(problem(factor * final + constant, tolerance=1e-3, subject_to=limits).steps)
    assert len(steps) == 1


@pytest.mark.thorough
def test_constraints_count_with_their_limits():
    """A response of 1 % of its limit may have an error of its own size."""
    final = mbd.Final(mbd.Position("bob", "x"))
    free = problem(mbd.Mass("bob"), tolerance=1e-3, subject_to=[final <= 1.0])
    tight = problem(mbd.Mass("bob"), tolerance=1e-3, subject_to=[final <= abs(exact())])
    assert (free.steps or 0) < (tight.steps or 0)


@pytest.mark.thorough
def test_given_steps_stay():
    given = problem(steps=50, tolerance=1e-6)
    assert given.steps == 50
    assert given.refined(given.start) is None
    assert given.coarse is None
    choice = steps_for(given, given.start, 50, 1e-3)
    assert (choice.steps or 0) > 50  # what they would be


@pytest.mark.thorough
def test_without_a_tolerance_the_motion_chooses():
    plain = problem(tolerance=None)
    motion = mbd.simulate(mass_on_a_spring(), 1.0, gradients="none")
    assert plain.steps == motion.stats["steps"]


@pytest.mark.thorough
def test_a_heavier_design_needs_no_more_steps_and_a_lighter_one_does():
    chosen = problem(mbd.RMS(mbd.Position("bob", "x")), tolerance=1e-4)
    assert chosen.refined(np.array([2.0])) is None
    finer = chosen.refined(np.array([0.5]))
    assert finer.steps > chosen.steps
    assert finer.settings() != chosen.settings()
    assert finer.refined(np.array([0.5])) is None
    assert chosen.steps == problem(mbd.RMS(mbd.Position("bob", "x")), tolerance=1e-4).steps


@pytest.mark.thorough
def test_a_tolerance_that_no_number_of_steps_reaches(monkeypatch):
    """The steps with the least error of those that were tried are taken."""
    monkeypatch.setattr(problem_steps.steps_for, "__defaults__", (None, None, 2, 0.0))
    small = problem(tolerance=1e-7)
    with warned("tolerance = 1e-07", "2000 steps", " %"):
        assert small.steps == 2000


def test_bad_input():
    for tolerance in (0.0, 1.0, -0.1, "small", True, float("nan")):
        with refused("tolerance"):
            problem(tolerance=tolerance)


@pytest.mark.thorough
def test_an_error_that_is_small_enough_needs_no_third_motion(monkeypatch):
    """Half of the steps are enough; and the objective at the start is known from the choice of its steps."""
    chosen = problem(mbd.RMS(mbd.Position("bob", "x")), tolerance=0.01)
    steps, motions = chosen.steps, []
    simulated = problem_steps._motions
    monkeypatch.setattr(problem_steps, "_motions", lambda *a: motions.extend(result := simulated(*a)) or result)
    monkeypatch.setattr(type(chosen), "motion", lambda *_: pytest.fail("the start was simulated again"))
    assert chosen.refined(np.array([2.0])) is None
    [motion] = motions
    assert 2 * motion.integration.steps == steps
    assert list(motion.repetition.made) == [2]


@pytest.mark.thorough
def test_a_search_takes_more_steps_where_its_design_needs_them():
    """From heavy to light: the mass is minimized, the vibration limited at least."""
    rms = mbd.RMS(mbd.Position("bob", "x"))
    search = problem(
        mbd.Mass("bob"), subject_to=[rms >= 0.0], tolerance=1e-4, start=[2.0], bounds=(0.5, 2.0), steps=None
    )
    seen = []
    result = mbd.optimize(search, max_iterations=12, callback=seen.append)
    assert result.x[0] == pytest.approx(0.5)
    assert result.problem.steps > search.steps
    assert result.problem.refined(result.x) is None
    assert [one.iteration for one in result.history] == list(range(result.iterations + 1))
    assert [one.iteration for one in seen] == [one.iteration for one in result.history]
    assert torch.tensor(result.value).isfinite()


@pytest.mark.thorough
def test_without_a_tolerance_a_search_has_one_part():
    plain = problem(tolerance=None)
    assert plain.coarse is None
    assert mbd.optimize(plain, max_iterations=6).iterations <= 6


@pytest.mark.thorough
def test_where_half_of_the_steps_fail_the_steps_themselves_are_the_measure(monkeypatch):
    """As where Newton's iterations do not converge by longer steps."""
    simulate, steps = mbd.Simulation.__call__, 600
    system_problem = problem(mbd.RMS(mbd.Position("bob", "x")), tolerance=1e-3, steps=steps)

    def fails(*args, **options):
        motion = simulate(*args, **options)
        if motion.integration.steps < steps:
            motion.status[0] = "failed: injected"
        return motion

    monkeypatch.setattr(mbd.Simulation, "__call__", fails)
    choice = steps_for(system_problem, system_problem.start, steps, 1e-3)
    assert math.isfinite(choice.error)
    assert choice.steps is not None
    assert choice.steps >= steps


@pytest.mark.thorough
def test_the_choice_is_a_stage():
    heard = []
    with stages_told(heard.append):
        _ = problem().steps
    assert heard[0] == "choosing the steps for the start design"


@pytest.mark.thorough
def test_a_choice_costs_half_a_motion_more_than_the_motion_that_it_chooses(simulated):
    """The motion by the chosen steps is compared with one of 2.3 times longer steps."""
    chosen = problem(mbd.RMS(mbd.Position("bob", "x"))).steps or 0
    assert chosen in simulated
    assert sum(simulated) < 1.5 * chosen


@pytest.mark.thorough
def test_equal_problems_choose_once(simulated):
    """Two systems of equal contents are equal; another number of the system or the motion is not."""
    rms = mbd.RMS(mbd.Position("bob", "x"))
    first = problem(rms).steps
    simulated.clear()
    assert problem(rms).steps == first
    assert problem(rms).coarse is None
    assert simulated == []
    stiff = mbd.Problem(mass_on_a_spring(8.0e3), 1.0, rms, variables=["bob.mass"], bounds=(0.5, 2.0))
    others = problem(rms, tolerance=0.02), problem(rms, 1.5), problem(2.0 * rms + 1.0), problem(rms, start=[0.6]), stiff
    for other in others:
        simulated.clear()
        assert other.steps
        assert simulated


@pytest.mark.thorough
def test_a_problem_that_cannot_be_compared_chooses_for_itself(simulated):
    """As one whose response holds a lock: nothing of it is kept for others."""

    class Locked(mbd.Position):
        def __init__(self, *args):
            super().__init__(*args)
            self.lock = threading.Lock()

    steps = {problem(mbd.RMS(Locked("bob", "x"))).steps for _ in range(2)}
    assert len(steps) == 1
    assert len(set(simulated)) * 2 == len(simulated)


def test_processes_take_the_steps_of_the_problem():
    """A copy of the problem in another process does not choose again."""
    chosen = problem()
    make, arguments = mbd.optimization.Processes(chosen, 1).factory
    assert make(*arguments).simulation.steps == chosen.steps  # pyright: ignore[reportAttributeAccessIssue]


def test_an_unknown_error_names_its_response_and_the_reason():
    text = str(problem_steps.StepChoice(1600, math.inf, "max of |z displacement of panel|", "it has no number"))
    assert text == "with 1600 steps the error of max of |z displacement of panel| is not known (it has no number)"
