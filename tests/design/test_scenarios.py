"""One design in several scenarios, as one batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from tests.study import rod_model
from torchmbd.fem.reduction import basis

pytestmark = pytest.mark.usefixtures("compiled")

ENERGY = mbd.StrainEnergy("arm")
TIP = abs(mbd.Displacement("arm", "z", node="right"))


def system(hinge_name: str = "hinge") -> mbd.System:
    """The arm, whose tool has a mass that can be set."""
    carbon, plate = mbd.examples.carbon(), mbd.mesh.rectangle(length=0.5, width=0.05, cells=(4, 2))
    body = mbd.FlexibleBody.plate(
        "arm",
        plate,
        mbd.Laminate(carbon, mbd.deg([45.0, -30.0]), thickness=1e-3),
        modes=2,
        position=(0.25, 0, 0),
        axes=[[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    )
    tool = mbd.RigidBody("tool", mass=mbd.variable(0.2), inertia=(1e-4, 1e-4, 1e-4), position=(0.5, 0, 0))
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at("left"), axis="z", name=hinge_name)
    grip = mbd.Fixed(body.at("right"), tool.at(0, 0, 0), name="grip")
    return mbd.System([body, tool], [hinge, grip], gravity=(0, -9.81, 0))


MASSES = np.linspace(0.05, 0.5, 20).tolist()
CASES = {f"{mass:.3f} kg": {"tool.mass": mass} for mass in MASSES}


def problem(cases=CASES, **options) -> mbd.Scenarios:
    given = {"minimize": mbd.Integral(ENERGY), "subject_to": mbd.Integral(TIP) <= "initial", "steps": 20}
    given |= {"variables": ["arm.laminate.angles"], "bounds": mbd.deg([-90, 90])}
    return mbd.Scenarios(system(), 0.02, **given | options, scenarios=cases)


def single(mass: float, x: np.ndarray) -> float:
    one = system()
    motion = mbd.simulate(
        one,
        0.02,
        steps=20,
        designs={"arm.laminate.angles": torch.tensor(x)[None], "tool.mass": torch.tensor([mass], dtype=torch.float64)},
        gradients="none",
    )
    return mbd.Integral(ENERGY)(motion).item()


X = np.array([0.6, -0.4])


@pytest.mark.thorough
def test_they_are_the_motions_one_by_one():
    alone = np.array([single(mass, X) for mass in MASSES[::7]])
    some = {key: CASES[key] for key in list(CASES)[::7]}
    [mean] = problem(some, objective="mean").evaluate(X[None], False)
    assert mean.objective == pytest.approx(alone.mean(), rel=1e-9)
    weights = [1.0, 2.0, 5.0]
    [weighted] = problem(some, objective="mean", weights=weights).evaluate(X[None], False)
    assert weighted.objective == pytest.approx(np.average(alone, weights=weights), rel=1e-9)
    worst = problem(some)
    assert worst.names[-1] == "bound"
    [result] = worst.evaluate(np.append(X, 0.7)[None], False)
    assert result.objective + worst.reference.extra.unit * result.constraints[:3].max() == pytest.approx(
        alone.max(), rel=1e-9
    )


@pytest.mark.thorough
def test_scenarios_of_a_design_share_its_modes(monkeypatch):
    lanes, solve = [], basis.cut_modes
    monkeypatch.setattr(basis, "cut_modes", lambda *x: lanes.append(len(x[-2])) or solve(*x))
    mean = problem(objective="mean")
    _ = mean.reference
    lanes.clear()
    mean.evaluate(np.array([X, X + 0.1, X - 0.3]), True)
    assert lanes == [3]


@pytest.mark.thorough
@pytest.mark.parametrize("constraints", ["each", "worst", "mean"])
@pytest.mark.parametrize("gradients", ["forward", "reverse"])
def test_gradients_of_twenty_load_cases_are_those_of_differences(constraints, gradients):
    asked = problem(objective="mean", constraints=constraints, gradients=gradients)
    [exact] = asked.evaluate(X[None], True)
    assert len(exact.constraints) == asked.rows == (20 if constraints == "each" else 1)
    h, slopes = 1e-3, []
    for k in range(2):
        e = np.eye(2)[k]
        designs = np.stack([X + step * e for step in (h, -h, h / 2, -h / 2)])
        rows = np.array([[f.objective, *f.constraints] for f in asked.evaluate(designs, False)])
        coarse, fine = (rows[0] - rows[1]) / (2 * h), (rows[2] - rows[3]) / h
        slopes.append((4 * fine - coarse) / 3)
    expected = np.stack(slopes, 1)
    got = np.vstack([exact.objective_gradient, exact.constraint_gradients])
    np.testing.assert_allclose(got, expected, atol=1e-6 * np.abs(expected).max(), rtol=0)


def test_a_failing_scenario_is_named_and_the_others_designs_go_on():
    cases = {"light": {"tool.mass": 0.1}, "none": {"tool.mass": 1e308}}
    [result] = problem(cases, objective="mean", subject_to=()).evaluate(X[None], True)
    assert "scenario 'none'" in result.status


@pytest.mark.thorough
def test_an_optimum_of_the_mean():
    cases = {key: CASES[key] for key in list(CASES)[::9]}
    asked = problem(cases, objective="mean", subject_to=())
    [before] = asked.evaluate(asked.start[None], False)
    result = mbd.optimize(asked, method="slsqp", max_iterations=4)
    assert result.value < before.objective


@pytest.mark.parametrize(
    ("options", "path"),
    [
        ({"objective": "each"}, "objective"),
        ({"constraints": "all"}, "constraints"),
        ({"weights": [1.0]}, "weights"),
        ({"cases": {"a": {"tool.mas": 1.0}}}, "scenarios.a.tool.mas"),
        ({"cases": {"a": {"arm.laminate.angles": [0.0, 1.0]}}}, "scenarios.a.arm.laminate.angles"),
        ({"cases": {"a": {"tool.mass": "heavy"}}}, "scenarios.a.tool.mass"),
        ({"cases": {"a": {"tool.mass": -0.1}}}, "scenarios.a.tool.mass"),
        ({"cases": []}, "scenarios"),
    ],
)  # fmt: skip
def test_what_is_refused(options, path):
    with refused(path):
        problem(**options)


@pytest.mark.thorough
@pytest.mark.parametrize("asked", [("worst", "each"), ("mean", "worst")])
def test_systems_of_different_topology(asked):
    """Two systems, one of them with two payloads: gradients against differences; each scenario is its own motion."""
    energy, plain, loaded = mbd.StrainEnergy("rod"), rod_model.build(), rod_model.build(payload=0.2)
    assert len(plain.bodies) + 1 == len(loaded.bodies)
    thick = "rod.laminate.thickness"
    cases = {
        "loaded": {"system": loaded},
        "plain": {},
        "loaded and thick": {"system": loaded, thick: [4e-3, 4e-3]},
        "thick": {thick: [4e-3, 4e-3]},
    }
    problem = mbd.Scenarios(
        plain,
        0.002,
        mbd.Integral(energy),
        [mbd.Max(energy) <= "initial"],
        scenarios=cases,
        objective=asked[0],
        constraints=asked[1],
        variables=["rod.laminate.angles"],
        bounds=mbd.deg([-90, 90]),
        steps=8,
        gradients="reverse",
    )
    assert [(g.indices, list(g.settings)) for g in problem.groups] == [
        ([0, 2], ["loaded", "loaded and thick"]),
        ([1, 3], ["plain", "thick"]),
    ]
    with refused("scenarios"):
        problem.motions(problem.start)
    result = [mbd.Integral(energy)(motion) for motion in problem.motions_by_system(problem.start)]
    values = torch.stack(result, 1).reshape(-1).detach().numpy()  # in the order of the scenarios
    x = problem.start.copy()
    x[:2] += 0.1
    [at_start], [e] = problem.evaluate(problem.start[None], False), problem.evaluate(x[None], True)
    assert e.status == "ok"
    if asked[0] == "mean":
        assert at_start.objective == pytest.approx(values.mean(), rel=1e-12)
    else:
        np.testing.assert_allclose(at_start.constraints[:4], values / values.max() - 1.0, atol=1e-12)
    steps, slopes = (1e-2, 5e-3), []
    for h in steps:
        moved = np.concatenate([x + h * np.eye(x.size)[:2], x - h * np.eye(x.size)[:2]])
        rows = np.array([[o.objective, *o.constraints] for o in problem.evaluate(moved, False)])
        slopes.append((rows[:2] - rows[2:]) / (2 * h))
    difference = (4 * slopes[1] - slopes[0]) / 3
    exact = np.vstack([e.objective_gradient, e.constraint_gradients])[:, :2].T
    np.testing.assert_allclose(exact, difference, rtol=1e-6, atol=1e-6 * np.abs(difference).max())
    with refused("scenarios.three.system"):
        mbd.Scenarios(plain, 0.002, mbd.Integral(energy), scenarios={"three": {"system": rod_model.build(3)}}, steps=8)
    with refused("scenarios.a.system", 3):
        mbd.Scenarios(plain, 0.002, mbd.Integral(energy), scenarios={"a": {"system": 3}}, steps=8)


@pytest.mark.thorough
def test_its_motion_is_that_of_a_scenario_and_not_of_the_model_as_it_is_built():
    cases = {"light": {"tool.mass": 0.05}, "heavy": {"tool.mass": 0.5}}
    asked = problem(cases, objective="mean", minimize=mbd.Max(abs(TIP)))
    assert asked.largest(X) == "heavy"
    of = {name: float(mbd.Max(abs(TIP))(asked.simulate(X[None], scenario=name))[0]) for name in cases}
    assert asked.evaluate(X[None], False)[0].objective == pytest.approx(np.mean(list(of.values())), rel=1e-9)
    assert float(mbd.Max(abs(TIP))(asked.motion(X))[0]) == pytest.approx(of["heavy"], rel=1e-12)
    with refused("scenario", "hevy", meant="heavy"):
        asked.simulate(X[None], scenario="hevy")


@pytest.mark.thorough
@pytest.mark.parametrize("constraints", ["each", "worst"])
def test_where_the_objective_is_the_same_the_largest_is_the_scenario_nearest_to_a_limit(constraints):
    cases = {"light": {"tool.mass": 0.05}, "heavy": {"tool.mass": 0.5}, "middle": {"tool.mass": 0.3}}
    limits = [mbd.Frequency("arm") >= 1.0, mbd.Max(TIP) <= 1e-3]
    asked = problem(cases, minimize=mbd.Mass("arm"), subject_to=limits, constraints=constraints)
    assert asked.largest(X) == "heavy"
    assert problem(cases, minimize=mbd.Mass("arm"), subject_to=[]).largest(X) == "light"


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["at_most", "at_least"])
def test_the_initial_design_keeps_the_worst_of_its_own_limits(kind):
    cases = {"light": {"tool.mass": 0.05}, "heavy": {"tool.mass": 0.5}}
    constraint = mbd.Constraint(mbd.Integral(TIP), "initial", kind)
    asked = problem(cases, objective="mean", subject_to=constraint, constraints="worst")
    [result] = asked.evaluate(asked.start[None], False)
    assert result.constraints == pytest.approx([0.0], abs=1e-12)


def test_an_initial_design_that_nothing_refers_to_is_not_needed(monkeypatch):
    asked = problem(dict(list(CASES.items())[:2]), objective="mean", subject_to=mbd.Integral(TIP) <= 1.0)

    def refuse(x):
        raise AssertionError("the initial design is simulated")

    monkeypatch.setattr(asked, "motions_by_system", refuse)
    assert asked.limits.tolist() == [1.0, 1.0]


def test_phases_that_a_system_of_a_scenario_cannot_have_are_refused():
    phases = [mbd.Phase(until=0.01, lock=["hinge"]), mbd.Phase()]
    other = system(hinge_name="axle")
    with refused("phases.1.lock", "hinge"):
        problem({"a": {"system": other}}, phases=phases)
