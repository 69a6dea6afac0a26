"""Formulations: min-max, time-dependent constraints, weighted sums, equalities, links, thickness beside angles.

On a small soft pendulum; optima found by one formulation are checked by another, or by simulating neighbors.
"""

# pyright: reportArgumentType=false, reportOperatorIssue=false, reportOptionalMemberAccess=false, reportOptionalOperand=false
# Wrong types are given on purpose.
from __future__ import annotations

import math

import numpy as np
import pytest

import torchmbd as mbd
from tests.mechanisms import CARBON, laminate, pendulum, plate
from tests.refused import refused
from torchmbd.design import (
    AtPeaks,
    AtTimes,
    DesignSpace,
    Frequency,
    Mass,
    RelativeDisplacement,
    SmoothMax,
    WeightedSum,
)
from torchmbd.errors import InputError

pytestmark = pytest.mark.usefixtures("compiled")

PLY: dict = CARBON
ENERGY = mbd.StrainEnergy("rod")
ANGLES, THICKNESS = "rod.laminate.angles", "rod.laminate.thickness"


def problem(minimize=None, subject_to=(), **given) -> mbd.Problem:
    asked = {
        "duration": 0.03,
        "bounds": mbd.deg([-90, 90]),
        "steps": 15,
        "iterations": (5, 5),
        "refresh": 1,
    }
    return mbd.Problem(
        pendulum(),
        minimize=mbd.Integral(ENERGY) if minimize is None else minimize,
        subject_to=subject_to,
        **(asked | given),
    )


def against_differences(p: mbd.Problem, x: np.ndarray, h: float = 2e-4, tolerance: float = 1e-5) -> None:
    (result,) = p.evaluate(x[None], gradients=True)
    assert result.ok
    shifts = np.concatenate([k * h * np.eye(len(x)) for k in (-2, -1, 1, 2)])
    rows = np.array([[e.objective, *e.constraints] for e in p.evaluate(x + shifts, gradients=False)])
    a, b, c, d = rows.reshape(4, len(x), -1)
    slopes = ((a - 8 * b + 8 * c - d) / (12 * h)).T
    assert result.objective_gradient is not None
    assert result.constraint_gradients is not None
    exact = np.vstack([result.objective_gradient, result.constraint_gradients])
    assert exact == pytest.approx(slopes, abs=tolerance * np.abs(slopes).max())


@pytest.mark.thorough
def test_min_max_by_an_extra_variable_has_the_paper_s_form():
    """(19), (20): the objective is the bound, rows are U(t_k)/U_0 - beta, the other constraints follow."""
    p = problem(AtPeaks(ENERGY, count=4), [mbd.Integral(ENERGY) <= "initial"], bound=(0.8, 1.5))
    assert p.names[-1] == "bound"
    assert (p.start[-1], p.lower[-1], p.upper[-1], p.period[-1]) == (0.8, -np.inf, 1.5, 0.0)
    peak = float(mbd.Max(ENERGY).value(p.motion(p.start))[0])
    (first,) = p.evaluate(p.start[None], gradients=False)
    assert first.objective == pytest.approx(0.8 * peak)
    assert first.constraints[0] == pytest.approx(1.0 - 0.8)
    assert len(first.constraints) == 5
    assert first.constraints[4] == pytest.approx(0.0, abs=1e-12)
    assert first.constraints[0] == max(first.constraints[:4])
    against_differences(p, np.array([0.5, -0.3, 0.7]))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["slsqp", "mmfd"])
def test_min_max_by_an_extra_variable_ends_where_the_direct_one_does(method):
    result = mbd.optimize(problem(AtPeaks(ENERGY, count=6)), method=method)
    assert result.violation <= 1e-6
    # The bound is tight, and the direct formulation finds nothing better from there.
    assert result.value == pytest.approx(float(mbd.Max(ENERGY).value(result.motion)[0]), rel=1e-4)
    direct = mbd.optimize(problem(mbd.Max(ENERGY)), method="mmfd", start=result.x[:2])
    assert direct.value >= result.value * 0.998
    assert result.value < 0.9 * float(mbd.Max(ENERGY).value(start_motion())[0])


def start_motion() -> mbd.Trajectory:
    p = problem()
    return p.motion(p.start)


@pytest.mark.slow
@pytest.mark.parametrize(
    "held",
    [
        AtTimes(ENERGY, count=31),
        AtPeaks(ENERGY, count=5),
        SmoothMax(ENERGY, sharpness=200.0, scale=1e-4),
        mbd.Max(ENERGY),
    ],
    ids=["all times", "critical times", "aggregated", "peak"],
)
def test_time_dependent_constraints_hold_between_the_samples(held):
    """(22), (23): the largest integral of energy where the energy never exceeds a limit that bites."""
    limit = 0.8 * float(mbd.Max(ENERGY).value(start_motion())[0])
    result = mbd.optimize(problem(-1.0 * mbd.Integral(ENERGY), [held <= limit]), method="slsqp", max_iterations=15)
    assert result.violation <= 1e-6
    designs = result.problem.space.designs(result.x[None])
    fine = mbd.simulate(result.problem.system, 0.03, steps=480, designs=designs, iterations=(5, 5))
    peak = float(fine.body("rod").strain_energy.max())
    assert peak <= limit * (1.0 + 5e-3)  # between samples, and with sixteen times as many time steps
    assert peak >= limit * 0.85  # the most that is allowed is used


@pytest.mark.thorough
def test_initial_limits_of_rows_are_the_largest():
    p = problem(subject_to=[AtPeaks(ENERGY, count=4) <= "initial", mbd.Max(ENERGY) <= "initial"])
    assert p.limits[:4] == pytest.approx([p.limits[4]] * 4)
    assert len(p.limits) == 5
    failed = p.evaluate(np.array([[np.nan, 0.0]]), gradients=False)[0]
    assert failed.constraints.shape == (5,)


@pytest.mark.thorough
def test_weighted_sum_is_one_at_the_start():
    """(38), normalized by the initial design: weights 0.6 and 0.4 make one, whatever the units."""
    lag = RelativeDisplacement("rod", 0, "right", "z")
    both = WeightedSum([(0.6, mbd.Integral(ENERGY)), (0.4, mbd.Integral(lag**2))])
    p = problem(both)
    (first,) = p.evaluate(p.start[None], gradients=False)
    assert first.objective == pytest.approx(1.0, abs=1e-12)
    against_differences(p, np.array([0.6, 0.2]))
    with refused("normalize", "initial"):
        both.value(p.motion(p.start))
    raw = problem(WeightedSum([(0.6, mbd.Integral(ENERGY)), (4e3, mbd.Integral(lag**2))], normalize=None))
    motion = raw.motion(raw.start)
    expected = 0.6 * mbd.Integral(ENERGY).value(motion)[0] + 4e3 * mbd.Integral(lag**2).value(motion)[0]
    assert raw.evaluate(raw.start[None], gradients=False)[0].objective == pytest.approx(float(expected))


@pytest.mark.thorough
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_weighted_sum_falls_with_its_measures_whatever_their_sign(sign):
    """Divided by the size of the start's value: a negative measure is not maximized."""
    measure = sign * mbd.Integral(ENERGY)
    (single,), (weighted,) = (
        p.evaluate(p.start[None], True) for p in (problem(measure), problem(WeightedSum([(0.6, measure)])))
    )
    assert weighted.objective == pytest.approx(0.6 * sign, rel=1e-12)
    assert weighted.objective_gradient == pytest.approx(
        0.6 * single.objective_gradient / abs(single.objective), rel=1e-9
    )
    with refused("normalize", (-1.0,)):
        WeightedSum([(1.0, measure)], normalize=(-1.0,))


@pytest.mark.thorough
def test_equalities_are_met():
    """Least integral of energy at a given mass, over angles and thicknesses."""
    p = problem(
        mbd.Integral(ENERGY),
        [Mass("rod").equals(0.16), mbd.Max(ENERGY) <= "initial"],
        variables=[ANGLES, THICKNESS],
        bounds={ANGLES: mbd.deg([-90, 90]), THICKNESS: (0.5e-3, 3e-3)},
    )
    assert p.equalities.tolist() == [0]
    result = mbd.optimize(p, method="slsqp", max_iterations=8)
    assert float(Mass("rod").value(result.motion)[0]) == pytest.approx(0.16, rel=1e-5)
    assert result.violation <= 1e-6
    assert result.value < result.history[0].objective


@pytest.mark.thorough
def test_lower_limits_and_scales():
    p = problem(subject_to=[mbd.Integral(ENERGY) >= 1e-6, Frequency("rod").equals(0.0, scale=10.0)])
    motion = p.motion(p.start)
    (result,) = p.evaluate(p.start[None], gradients=False)
    integral, frequency = (
        float(mbd.Integral(ENERGY).value(motion)[0]),
        float(Frequency("rod").value(motion)[0]),
    )
    assert result.constraints == pytest.approx([(1e-6 - integral) / 1e-6, frequency / 10.0])
    assert p.equalities.tolist() == [1]
    against_differences(p, np.array([0.6, 0.2]))


@pytest.mark.thorough
def test_thickness_is_a_variable_beside_angles():
    """Gradients by both, in one vector of different units; the lightest rod within its bound on energy."""
    given = {
        "variables": [ANGLES, THICKNESS],
        "bounds": {ANGLES: mbd.deg([-90, 90]), THICKNESS: ([0.5e-3, 0.6e-3], 3e-3)},
    }
    p = problem(Mass("rod"), [mbd.Max(ENERGY) <= "initial"], **given)
    assert p.lower == pytest.approx([-math.pi / 2] * 2 + [0.5e-3, 0.6e-3])
    assert p.upper == pytest.approx([math.pi / 2] * 2 + [3e-3] * 2)
    assert p.period == pytest.approx([math.pi] * 2 + [0.0] * 2)
    (found,) = p.evaluate(p.start[None], gradients=True)
    # Mass: density x area x thickness, nothing of the angles.
    assert found.objective_gradient == pytest.approx([0.0, 0.0, 1586.0 * 0.03, 1586.0 * 0.03], rel=1e-9, abs=1e-9)
    result = mbd.optimize(p, method="slsqp")
    assert result.violation <= 1e-6
    assert result.value < 0.95 * result.history[0].objective


@pytest.mark.thorough
def test_linked_angles_follow():
    """A balanced pair +-theta is one variable; its gradient is that of the full design along the link."""
    links = {f"{ANGLES}[1]": {f"{ANGLES}[0]": -1.0}}
    p, full = problem(links=links), problem()
    assert p.names == [f"{ANGLES}[0]"]
    (one,) = p.evaluate(np.array([[0.4]]), gradients=True)
    (both,) = full.evaluate(np.array([[0.4, -0.4]]), gradients=True)
    assert one.objective == pytest.approx(both.objective, rel=1e-12)
    assert one.objective_gradient == pytest.approx([both.objective_gradient @ [1.0, -1.0]])
    assert p.motion(np.array([0.4])).designs[ANGLES].tolist() == [[0.4, -0.4]]


@pytest.mark.thorough
def test_links_with_offsets_and_symmetric_laminates():
    system = mbd.System([plate("one", made_of=laminate((10.0, 20.0, 30.0)))])
    name = "one.laminate.angles"
    space = DesignSpace(system, links={f"{name}[1]": {f"{name}[0]": 0.5, f"{name}[2]": -2.0, "constant": 0.1}})
    assert space.names == [f"{name}[0]", f"{name}[2]"]
    assert space.designs(np.array([[1.0, 3.0]]))[name].tolist() == [pytest.approx([1.0, 0.5 - 6.0 + 0.1, 3.0])]
    half = mbd.Laminate(mbd.Ply(**PLY), mbd.deg([10, 20]), 1e-3, symmetric=True)
    assert DesignSpace(mbd.System([plate("two", made_of=half)])).names == [f"two.laminate.angles[{i}]" for i in (0, 1)]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"links": {f"{ANGLES}[2]": {}}},
            ["rod.laminate.angles[2] is not an entry of a design variable", "Try:"],
        ),
        (
            {"links": {f"{ANGLES}[1]": {f"{ANGLES}[1]": 1.0}}},
            ["is not an entry, or follows others", "must be"],
        ),
        ({"links": {f"{ANGLES}[1]": 3.0}}, ["link of 'rod.laminate.angles[1]' = 3.0", "mapping"]),
        ({"links": {f"{ANGLES}[{i}]": {"constant": 0.0} for i in (0, 1)}}, ["links leave no entry free", "must leave"]),
        ({"bounds": {"rod.laminate.angle": (0, 1)}}, ["lower bound of parameter = 'rod.laminate.angle'", "Try:"]),
        ({"bounds": {ANGLES: (0, 1, 2)}}, [f"bounds of {ANGLES}", "two entries"]),
        ({"minimize": AtPeaks(ENERGY), "bound": (2.0, 1.0)}, ["bound = (2.0, 1.0)", "start <= upper"]),
        ({"minimize": mbd.Max(ENERGY, window=(0.0, 0.04))}, ["looks at t = 0.04 s", "duration=0.03"]),
        ({"subject_to": [AtTimes(ENERGY, times=(0.1,)) <= 1.0]}, ["looks at t = 0.1 s"]),
    ],
    ids=str,
)
def test_bad_input_is_refused_at_the_door(given, words):
    with pytest.raises(InputError) as error:
        problem(**given)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: AtPeaks(ENERGY) >= 1.0, "AtPeaks(-history) <= -limit"),
        (lambda: AtPeaks(ENERGY, count=0), "count = 0: must be an integer, at least 1"),
        (lambda: AtTimes(ENERGY, count=1), "count = 1: must be an integer, at least 2"),
        (lambda: AtTimes(ENERGY, times=()), "times = (): must be at least one time"),
        (lambda: AtTimes(ENERGY, times=(0.1,), window=(0.0, 1.0)), "times and window are both given"),
        (lambda: mbd.Max(ENERGY, window=(0.3, 0.1)), "window = (0.3, 0.1): must satisfy 0 <= t0 < t1"),
        (lambda: mbd.Max(ENERGY, window=0.3), "window = 0.3: must be two times"),
        (lambda: mbd.Max(mbd.Max(ENERGY)), "history of Max = Max("),
        (lambda: SmoothMax(ENERGY, sharpness=0.0, scale=1.0), "sharpness = 0.0: must be a positive number"),
        (lambda: WeightedSum([]), "terms = []: must be pairs"),
        (lambda: WeightedSum([(1.0, AtPeaks(ENERGY))]), "a measure of one number"),
        (lambda: WeightedSum([("1", mbd.Max(ENERGY))]), "Measure.factor = '1'"),
        (lambda: WeightedSum([(1.0, mbd.Max(ENERGY))], normalize=(1.0, 2.0)), "normalize = (1.0, 2.0)"),
        (lambda: mbd.Max(ENERGY) + "x", "part of sum = 'x': must be a measure of one number"),
        (lambda: ENERGY + "x", "operand = 'x'"),
        (lambda: ENERGY - mbd.variable(1.0), "has a gradient"),
        (lambda: mbd.Max(ENERGY) <= mbd.variable(1.0), "has a gradient"),
        (lambda: mbd.Max(ENERGY).equals(0.0, scale=-1.0), "scale of a constraint = -1.0"),
    ],
)
def test_bad_criteria_are_named(make, words):
    with pytest.raises(InputError) as error:
        make()
    assert words in str(error.value)


def test_a_number_may_be_a_tensor():
    angle = mbd.Angle("crank", "z")
    assert repr(angle - mbd.deg(90.0)) == repr(angle - float(mbd.deg(90.0)))
    assert repr(mbd.Max(angle) * mbd.deg(90.0)) == repr(mbd.Max(angle) * float(mbd.deg(90.0)))
    assert (mbd.Max(angle) <= mbd.deg(90.0)).limit == float(mbd.deg(90.0))
