"""The contract of keys: equal problems have equal keys, whatever was done with their system.

A change that changes a number of an evaluation changes the key.
"""

from __future__ import annotations

import copy
import inspect
import pickle
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from torchmbd.errors import argument_names
from torchmbd.study.record import paths
from torchmbd.study.record.paths import problem_key

PACKAGE = Path(mbd.__file__).parent
NAME, THICKNESS = "arm.laminate.angles", "arm.laminate.thickness"
LIFT = mbd.Displacement("arm", "z", node="right")
ENERGY = mbd.Integral(mbd.StrainEnergy("arm"))
ROWS = mbd.AtTimes(LIFT, count=8)
BRIEF: dict[str, Any] = {
    "duration": 0.01,
    "minimize": ENERGY,
    "bounds": mbd.deg([-90, 90]),
    "variables": [NAME],
    "start": mbd.deg([8.0, -8.0]),
    "steps": 6,
}
MIN_MAX: dict[str, Any] = {"duration": 0.05, "steps": 20, "minimize": ROWS, "bound": (1.0, 100.0)}


def problem(system: mbd.System | None = None, kind: Callable[..., Any] = mbd.Problem, **changes: Any) -> Any:
    arguments = {**BRIEF, **changes}
    return kind(
        mbd.examples.arm() if system is None else system, **{k: x for k, x in arguments.items() if x is not None}
    )


#: Argument of Problem -> problems that differ in it alone.
ARGUMENTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "system": ({}, {"system": mbd.examples.arm(modes=3)}),
    "duration": ({}, {"duration": 0.012}),
    "minimize": ({}, {"minimize": mbd.Max(LIFT)}),
    "maximize": ({}, {"minimize": None, "maximize": ENERGY}),
    "subject_to": ({"subject_to": mbd.Max(LIFT) <= 1.0}, {"subject_to": mbd.Max(LIFT) <= 2.0}),
    "bounds": (MIN_MAX, {**MIN_MAX, "bounds": mbd.deg([-12, 12])}),
    "variables": ({"start": None, "variables": [THICKNESS], "bounds": (0.0, 0.1)}, {"start": None}),
    "start": ({"subject_to": ENERGY <= "initial"}, {"subject_to": ENERGY <= "initial", "start": mbd.deg([9.0, -8.0])}),
    "method": ({}, {"method": "rk4"}),
    "steps": ({}, {"steps": 7}),
    "links": (
        {"links": {f"{NAME}[1]": {f"{NAME}[0]": -1.0}}, "start": mbd.deg([8.0])},
        {"links": {f"{NAME}[1]": {f"{NAME}[0]": 1.0}}, "start": mbd.deg([8.0])},
    ),
    "bound": (MIN_MAX, {**MIN_MAX, "bound": (1.0, 99.0)}),
    "phases": ({}, {"phases": [mbd.Phase(until=0.004, lock=["hinge"]), mbd.Phase()]}),
    "gradients": ({"gradients": "forward"}, {"gradients": "reverse"}),
    "backend": ({"backend": "eager"}, {}),
    "motion_start": ({}, {"motion_start": "equilibrium"}),
    "tolerance": ({"steps": None}, {"steps": None, "tolerance": 0.5}),
    "options": ({}, {"iterations": (9, 9)}),
}
#: The same of what a problem of several scenarios has in addition.
CASES = {"light": {THICKNESS: [1e-3, 1e-3]}, "heavy": {THICKNESS: [2e-3, 1e-3]}}
SCENARIOS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "scenarios": ({}, {"scenarios": CASES | {"heavy": {THICKNESS: [3e-3, 1e-3]}}}),
    "objective": ({}, {"objective": "mean"}),
    "constraints": ({"subject_to": ENERGY <= 1.0}, {"subject_to": ENERGY <= 1.0, "constraints": "mean"}),
    "weights": ({"objective": "mean"}, {"objective": "mean", "weights": [1.0, 2.0]}),
}


def test_every_argument_is_in_this_contract():
    assert set(ARGUMENTS) == set(argument_names(mbd.Problem)) | {"options"}
    own = set(inspect.signature(mbd.Scenarios.__init__).parameters) - set(argument_names(mbd.Problem))
    assert set(SCENARIOS) == own - {"self", "options"}


@pytest.mark.thorough
@pytest.mark.parametrize("argument", ARGUMENTS)
def test_each_argument_of_a_problem_changes_the_key(argument):
    first, second = (problem(**{**changes}) for changes in ARGUMENTS[argument])
    assert problem_key(first) != problem_key(second)


@pytest.mark.thorough
@pytest.mark.parametrize("argument", SCENARIOS)
def test_each_argument_of_scenarios_changes_the_key(argument):
    first, second = (problem(kind=mbd.Scenarios, **{"scenarios": CASES, **x}) for x in SCENARIOS[argument])
    assert problem_key(first) != problem_key(second)


@pytest.mark.thorough
@pytest.mark.parametrize("changes", [{"step": 2e-4}, {"scheme": "forward"}])
def test_each_argument_of_differences_changes_the_key(changes):
    one = problem()
    keys = {problem_key(one), problem_key(mbd.Differences(one)), problem_key(mbd.Differences(one, **changes))}
    assert len(keys) == 3


NARROW, X = mbd.deg([-12, 12]), mbd.deg([11.9999, -5.0])


def numbers(x: Any) -> tuple[Any, ...]:
    """The numbers of an evaluation with gradients."""
    [evaluation] = x.evaluate(np.append(X, [1.3] * (len(x.names) - len(X)))[None], True)
    assert evaluation.ok
    parts = ("objective", "constraints", "objective_gradient", "constraint_gradients")
    return tuple(getattr(evaluation, part) for part in parts)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("wide", "narrow", "same"),
    [
        (problem(), problem(bounds=NARROW), True),  # bounds affect the search alone
        (problem(**MIN_MAX), problem(**MIN_MAX, bounds=NARROW), False),  # they make the unit of the rows
        (mbd.Differences(problem()), mbd.Differences(problem(bounds=NARROW)), True),
        (mbd.Differences(problem(), 1e-3, "forward"), mbd.Differences(problem(bounds=NARROW), 1e-3, "forward"), False),
    ],
    ids=["one number", "min-max", "central differences", "forward differences"],
)
def test_bounds_change_the_key_where_they_change_numbers(wide, narrow, same):
    """Such a difference step goes backward near an upper bound."""
    equal = all(np.array_equal(a, b) for a, b in zip(numbers(wide), numbers(narrow), strict=True))
    assert (problem_key(wide) == problem_key(narrow), equal) == (same, same)


def use(system: mbd.System) -> None:
    """Uses of a system that leave its key as it is."""
    repr(system.describe())
    mbd.static_truncation(system)
    system().train()
    system.eval()
    mbd.simulate(system, 0.004, steps=4, gradients="reverse", variables=[NAME])
    mbd.simulate(system, 0.004, method="rk4", steps=40, phases=[mbd.Phase(until=0.001), mbd.Phase()])
    mbd.simulate(system, 0.004, steps=4, phases=[mbd.Phase(until=0.002, lock=["hinge"]), mbd.Phase()])
    mbd.equilibrium(system)
    result = mbd.optimize(problem(system, subject_to=ENERGY <= "initial"), max_iterations=1)
    mbd.verify(result)
    with torch.no_grad():
        system.get_parameter(NAME).add_(0.1)  # the problem has a start of its own
    system.load_state_dict(system.state_dict())


def bar() -> mbd.System:
    """A round bar that swings; its torsional modes pass the bending modes, so designs retain 3, 5 or 7 modes."""
    stiffness: Any = [[x if i == j else 0.0 for j in range(6)] for i, x in enumerate((2e7, 4e6, 4e6, 0.0, 4e2, 4e2))]
    stiffness[3][3] = mbd.variable(900.0)
    mass = torch.diag(torch.tensor([0.3, 0.3, 0.3, 4.8e-4, 2.4e-4, 2.4e-4], dtype=torch.float64))
    line = mbd.BeamLine.straight(1.0, elements=4)
    arm = mbd.FlexibleBody.beam("arm", line, mbd.GivenSection(stiffness, mass), modes=3, reference="start")
    tip = mbd.RigidBody("tip", mass=0.02, inertia=(2e-5, 2e-5, 2e-5), position=(1.0, 0.03, 0.02))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), arm.at("start"), axis="z", name="hinge"),
        mbd.Fixed(arm.at("end"), tip.at(0, -0.03, -0.02), name="clamp"),
    ]
    return mbd.System([arm, tip], joints, gravity=(0.0, -3.0, -9.81), truncation=None)


GJ = "arm.section.stiffness_44"
LAG = mbd.Displacement("arm", "y", node="end")
SWING: dict[str, Any] = {
    "duration": 0.01,
    "minimize": ENERGY,
    "subject_to": mbd.Max(LAG) <= 1.0,
    "bounds": (20.0, 3000.0),
    "start": [900.0],
    "steps": 8,
    "backend": "eager",
}
RETAINED = np.array([[30.0], [130.0], [316.0], [2500.0]])  # of 3, 5, 7 and 4 modes


def swing(kind: Callable[..., Any] = mbd.Problem, **changes: Any) -> Any:
    return kind(bar(), **{**SWING, **changes})


#: Kind of problem -> the problem, and options of its study.
KINDS: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    "plain": (swing, {}),
    "expected": (lambda: mbd.optimization.RobustProblem(swing(), 50.0), {}),
    "worst": (lambda: mbd.optimization.RobustProblem(swing(), 50.0, "worst"), {}),
    "scenarios": (partial(swing, mbd.Scenarios, variables=[GJ], scenarios=[{"system": bar()}, {}]), {}),
    "min-max": (partial(swing, minimize=mbd.AtTimes(LAG, count=5), bound=(1.0, 100.0)), {}),
    "aggregate": (
        partial(swing, subject_to=mbd.Aggregate([mbd.AtTimes(LAG, count=5), mbd.Max(LAG)], scale=1.0) <= 1.0),
        {},
    ),
    "phases": (partial(swing, phases=[mbd.Phase(until=0.004, lock=["hinge"]), mbd.Phase()]), {}),
    "discrete": (swing, {"increments": {GJ: 100.0}}),
    "tradeoff": (partial(swing, mbd.Tradeoff, minimize={"energy": ENERGY, "frequency": -mbd.Frequency("arm")}), {}),
    "differences": (lambda: mbd.Differences(swing()), {}),
}


def keys_of(one: Any, options: dict[str, Any]) -> tuple[str, ...]:
    study = mbd.Study(one, **options)
    return problem_key(one), problem_key(study.simulated), study.key("sqlite:///runs.db")


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::UserWarning")  # of short motions with few modes
@pytest.mark.parametrize("kind", KINDS)
def test_the_use_of_a_problem_leaves_its_keys(kind, tmp_path):
    """Evaluations of designs with other numbers of modes, errors, searches, verification, pictures."""
    make, options = KINDS[kind]
    one = make()
    before, uses = keys_of(one, options), []
    simulated = mbd.Study(one, **options).simulated

    def use(name: str, call: Callable[[], Any]) -> Any:
        result = call()
        uses.append((name, keys_of(one, options)))
        return result

    designs = np.hstack([RETAINED, np.ones((len(RETAINED), len(simulated.names) - 1))])
    assert all(e.ok for e in use("values", lambda: simulated.evaluate(designs, False)))
    use("gradients", lambda: one.evaluate(one.start[None], True))
    motion = use("motion", lambda: one.motion(one.start)) if hasattr(one, "motion") else None
    if motion is not None:
        use("error", lambda: motion.error_of(mbd.Final(LAG)))
        use("picture", lambda: mbd.viz.animate(motion, tmp_path / "bar.html"))
    if hasattr(simulated, "errors"):
        use("errors of responses", lambda: simulated.errors(simulated.start))
    if kind == "tradeoff":
        use("front", lambda: mbd.optimization.pareto_front(one, divisions=2, max_iterations=1))
    elif kind == "discrete":
        use(
            "discrete",
            lambda: mbd.optimization.optimize_discrete(one, [np.arange(100.0, 3000.0, 100.0)], max_iterations=1),
        )
    else:
        result = use("search", lambda: mbd.optimize(one, max_iterations=1, progress=False))
        if kind != "differences":
            use("verification", lambda: mbd.verify(result))
    assert uses == [(name, before) for name, _ in uses]
    assert keys_of(make(), options) == before


@pytest.mark.thorough
@pytest.mark.parametrize(
    "changes",
    [{}, MIN_MAX, ARGUMENTS["phases"][1], {"steps": None}],
    ids=["one number", "min-max", "phases", "chosen steps"],
)
def test_the_use_of_a_system_leaves_the_keys_of_its_problems(changes):
    system = mbd.examples.arm()
    one = problem(system, **changes)
    before = problem_key(one), mbd.Study(one).key("sqlite:///runs.db")
    one.evaluate(one.start[None], True)
    use(system)
    for other in (one, problem(system, **changes), copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert (problem_key(other), mbd.Study(other).key("sqlite:///runs.db")) == before
    assert problem_key(mbd.Differences(one)) == problem_key(mbd.Differences(problem(**changes)))


@pytest.mark.thorough
def test_a_constant_that_is_changed_in_place_changes_the_key():
    system = mbd.examples.arm()
    one = problem(system)
    before = problem_key(one)
    system.body("tool").position += 1e-3
    moved = problem_key(one)
    mbd.simulate(system, 0.002, steps=2)  # joins its bodies anew
    assert before != moved == problem_key(one)


@pytest.mark.thorough
def test_every_source_that_an_evaluation_enters_is_in_the_key(monkeypatch):
    """Each constant of these files can change a number."""
    entered: set[str] = set()

    def note(frame: Any, event: str, argument: Any) -> None:
        if frame.f_code.co_filename.startswith(str(PACKAGE)):
            entered.add(frame.f_code.co_filename)

    problems = [problem(**MIN_MAX), problem(steps=None), problem(kind=mbd.Scenarios, scenarios=CASES)]
    problems += [
        mbd.Differences(problems[0]),
        mbd.Tradeoff(mbd.examples.arm(), **{**BRIEF, "minimize": {"a": ENERGY, "b": mbd.Mass("arm")}}),
    ]
    sys.setprofile(note)
    try:
        for one in problems:
            one.evaluate(one.start[None], True)
    finally:
        sys.setprofile(None)
    places = [Path(file).relative_to(PACKAGE) for file in entered]
    assert Path("optimization/units.py") in places
    left_out = (*paths._SHOWN, *paths._SEARCHES)
    assert not [place for place in places if any(place.is_relative_to(part) for part in left_out)]
