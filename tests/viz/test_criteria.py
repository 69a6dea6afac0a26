"""Pictures of a question: what is drawn is what the problem asks for, with its limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import torchmbd as mbd
from tests.refused import refused
from torchmbd.optimization.optimizer import Iterate
from torchmbd.viz.panels import histories_of

ENERGY, ANGLE, FAILURE = mbd.StrainEnergy("arm"), mbd.Angle("arm", "z"), mbd.PlyFailure("arm")
SUM = mbd.WeightedSum([(0.7, mbd.Integral(ENERGY)), (0.3, mbd.RMS(ANGLE))])
LIMITS = [
    mbd.Max(ENERGY) <= "initial",
    mbd.Max(FAILURE, window=(0.01, 0.03)) <= 1.0,
    mbd.Min(ANGLE) >= -0.5,
    mbd.Mass("arm") <= 0.1,
]
LABELS = ["start", "best"]


@pytest.fixture(scope="module")
def problem() -> mbd.Problem:
    return mbd.Problem(mbd.examples.arm(), 0.05, SUM, LIMITS, bounds=(-1.5, 1.5), steps=40)


@pytest.fixture(scope="module")
def motion(problem):
    return problem.simulate(np.array([problem.start, [0.3, -0.2]]))


def curves(axes: Any) -> list[np.ndarray]:
    return [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines]


@pytest.mark.thorough
def test_every_history_is_drawn_once_with_its_limits(problem, motion, tmp_path):
    figure = mbd.viz.criteria_over_time(problem, motion, LABELS, "What is best?")
    energy, angle, failure, window = figure.axes
    assert energy.get_ylabel() == "strain energy of arm [J]"
    assert angle.get_ylabel() == "angle about z of arm [deg]"
    for axes, history, factor in ((energy, ENERGY, 1.0), (angle, ANGLE, 180.0 / np.pi), (failure, FAILURE, 1.0)):
        assert_allclose(curves(axes)[:2], factor * history(motion).detach().numpy())
    assert_allclose(curves(energy)[2], problem.limits[0])
    assert_allclose(problem.limits[0], float(mbd.Max(ENERGY)(motion)[0].detach()))
    assert "minimize weighted sum; max of strain energy at most" in energy.get_title(loc="left")
    assert "at least -28.65 deg" in angle.get_title(loc="left")
    assert [text.get_text() for text in failure.texts] == ["limit, at most 1: above"]  # far from the curves
    assert len(failure.patches) == 1  # the window, which is drawn once more by itself
    t = motion.t.numpy()
    inside = (FAILURE(motion).detach().numpy())[:, (t >= window.get_xlim()[0]) & (t <= window.get_xlim()[1])]
    assert window.get_title(loc="left").startswith("the window ")
    assert window.get_ylim()[0] < inside.min() < inside.max() < window.get_ylim()[1]
    assert window.get_ylim()[1] - window.get_ylim()[0] < 1.2 * np.ptp(inside)
    assert figure.get_suptitle() == "What is best?"
    assert mbd.viz.save(figure, tmp_path / "time.png").stat().st_size > 5000


@pytest.mark.thorough
def test_long_labels_stay_inside_the_figure(problem, motion):
    values = ", ".join(f"thickness {k} 0.275682 mm" for k in range(6))
    labels = [f"start design ({values})", f"best design ({values})"]
    over_time = mbd.viz.criteria_over_time(problem, motion, labels)
    failure = mbd.viz.failure_map(motion, "arm", labels)
    legends, titles = over_time.legends, [axes.title for axes in failure.axes]
    for figure in (over_time, failure):
        figure.draw_without_rendering()
    for figure, texts in ((over_time, legends), (failure, titles)):
        assert texts
        assert all(text.get_window_extent().x1 <= figure.bbox.x1 for text in texts)


@pytest.mark.thorough
def test_a_failed_lane_ends_where_it_fails(problem):
    motion = problem.simulate(np.array([problem.start]))
    values = ENERGY(motion).detach().clone()
    values[:, 20:] = torch.nan
    broken = mbd.Problem(problem.system, 0.05, mbd.Max(mbd.history(_given(values))), steps=40)
    figure = mbd.viz.criteria_over_time(broken, motion, ["start"])
    assert "fails at t" in figure.legends[0].get_texts()[0].get_text()


def _given(values: torch.Tensor) -> Any:
    def energy(motion: Any) -> torch.Tensor:
        return values

    return energy


def test_designs_without_histories_have_no_curves_over_time(motion):
    problem = mbd.Problem(mbd.examples.arm(), 0.05, mbd.Mass("arm"), steps=40)
    assert mbd.viz.criteria_over_time(problem, motion, LABELS) is None
    assert mbd.viz.weighted_parts(problem, motion, LABELS) is None


@pytest.mark.thorough
def test_responses_over_the_iterations_are_in_their_units(problem, motion):
    evaluations = problem.evaluate(np.array([problem.start, [0.3, -0.2]]), False)
    history = [
        Iterate(0, k, problem.start, result.objective, 0.0, result.constraints, k + 1)
        for k, result in enumerate(evaluations)
    ]
    figure = mbd.viz.criteria_over_iterations(problem, {"start 0": history, "start 1": history[:1]}, best="start 0")
    rows = figure.axes
    assert [axes.get_ylabel().replace("\n", " ") for axes in rows] == [
        "weighted sum",
        "max of strain energy of arm [J]",
        "max of ply failure of arm",
        "min of angle about z of arm [deg]",
        "mass of arm [kg]",
    ]
    expected = [c.measure(motion).detach().numpy() for c in problem.constraints]
    expected[2] = np.degrees(expected[2])
    for axes, values in zip(rows[1:], expected, strict=True):
        assert_allclose(curves(axes)[1], values, rtol=1e-9, atol=1e-12)  # an angle of 0 rounds
    written = " ".join(text.get_text() for text in rows[3].texts) + rows[3].get_title(loc="left")
    assert "-28.65" in written  # the limit, -0.5 rad, is far below the curves
    with refused("searches", {}):
        mbd.viz.criteria_over_iterations(problem, {"start 0": []})


@pytest.mark.thorough
def test_min_max_problems_draw_their_constraints(motion):
    peaks = mbd.AtPeaks(ENERGY, count=2)
    problem = mbd.Problem(mbd.examples.arm(), 0.05, peaks, mbd.Max(ENERGY) <= 1.0, steps=40)
    [result] = problem.evaluate(problem.start[None], False)
    history = [Iterate(0, 0, problem.start, result.objective, 0.0, result.constraints, 1)]
    figure = mbd.viz.criteria_over_iterations(problem, {"start 0": history})
    assert_allclose(curves(figure.axes[1])[0], float(mbd.Max(ENERGY)(motion)[0].detach()))


@pytest.mark.thorough
def test_parts_of_a_sum_add_up(problem, motion):
    figure = mbd.viz.weighted_parts(problem, motion, LABELS)
    (axes,) = figure.axes
    widths = np.array([bar.get_width() for bar in axes.patches]).reshape(2, 2)  # designs, terms
    assert_allclose(widths[0], [0.7, 0.3])  # divided by those of the start
    objectives = [e.objective for e in problem.evaluate(np.array([problem.start, [0.3, -0.2]]), False)]
    assert_allclose(widths.sum(1), objectives)
    assert "integral of strain" in axes.get_yticklabels()[0].get_text()


def test_the_failure_map_holds_the_largest_index(motion):
    figure = mbd.viz.failure_map(motion, "arm", LABELS)
    drawn = [np.asarray(axes.collections[0].get_array()).max() for axes in figure.axes[:2]]
    assert_allclose(drawn, FAILURE(motion).detach().amax(1).numpy(), rtol=1e-12)
    with refused("labels", ["start"]):
        mbd.viz.failure_map(motion, "arm", ["start"])


@pytest.mark.thorough
def test_the_failure_map_of_a_beam():
    tube = mbd.sections.tube(0.02, mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3, cells=(12, 1))
    rod = mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(0.5, 3), tube, modes=2, reference="start")
    push = mbd.Force(rod.at("end"), (0, 0, 10.0))
    system = mbd.System([rod], [mbd.Fixed(mbd.Ground().at(), rod.at("start"))], [push])
    motion = mbd.simulate(system, 0.01, steps=80)
    (axes,) = mbd.viz.failure_map(motion, "rod", ["start"]).axes
    x, y = axes.lines[0].get_data()
    assert_allclose([x[0], x[-1]], [0.0, 0.5])
    assert_allclose(np.max(y), mbd.SectionHistory(motion, "rod").failure().amax().item(), rtol=1e-12)


@pytest.mark.thorough
def test_beams_of_a_failure_map_have_the_lengths_of_their_designs():
    tube = mbd.sections.tube(0.02, mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3, cells=(12, 1))
    line = mbd.BeamLine.straight(mbd.variable(0.5), 3)
    rod = mbd.FlexibleBody.beam("rod", line, tube, modes=2, reference="start")
    system = mbd.System([rod], [mbd.Fixed(mbd.Ground().at(), rod.at("start"))], [mbd.Force(rod.at("end"), (0, 0, 9.0))])
    designs = {"rod.line.length": torch.tensor([0.5, 0.4], dtype=torch.float64)}
    motion = mbd.simulate(system, 0.005, steps=10, designs=designs, gradients="none")
    (axes,) = mbd.viz.failure_map(motion, "rod", ["start", "best"]).axes
    curves = [line for line in axes.lines if len(line.get_xdata()) > 1]  # the other lines are marks
    assert_allclose([np.max(line.get_xdata()) for line in curves], [0.5, 0.4])
    assert axes.get_xlabel() == "length along rod [m]"


@pytest.mark.thorough
def test_parts_of_a_failure_map_lie_where_they_are_along_the_beam():
    """A wide section, a narrow one, and the wide one again; the moment of a force at the tip falls to zero along all."""
    wide, narrow = (
        mbd.sections.tube(r, mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3, cells=(12, 1))
        for r in (0.03, 0.02)
    )
    line = mbd.BeamLine.straight(mbd.variable(0.5), 5)
    rod = mbd.FlexibleBody.beam("rod", line, [wide, narrow, narrow, wide, wide], modes=2, reference="start")
    system = mbd.System([rod], [mbd.Fixed(mbd.Ground().at(), rod.at("start"))], [mbd.Force(rod.at("end"), (0, 0, 9.0))])
    designs = {"rod.line.length": torch.tensor([0.5, 0.4], dtype=torch.float64)}
    motion = mbd.simulate(system, 0.005, steps=10, designs=designs, gradients="none")
    figure = mbd.viz.failure_map(motion, "rod", ["start design (" + "thickness 0.275682 mm, " * 12, "best"])
    for axes, elements in zip(figure.axes, ([0, 3, 4], [1, 2]), strict=True):
        curves = [line for line in axes.lines if len(line.get_xdata()) > 1]
        for curve, length in zip(curves, (0.5, 0.4), strict=True):
            x = np.asarray(curve.get_xdata())
            places = [[length * k / 5, length * (k + 1) / 5] for k in elements]
            assert_allclose(x[np.isfinite(x)], np.ravel(places), atol=1e-15)
            assert np.isnan(x).sum() == (elements[0] == 0)  # the part has a gap, where the other section is
            assert_allclose(axes.get_xlim(), (-0.025, 0.525), atol=1e-12)
    figure.draw_without_rendering()
    for axes in figure.axes:
        box = axes.get_legend().get_window_extent()
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
        assert axes.bbox.height > 100.0


@pytest.mark.thorough
def test_pictures_of_designs_number_them_without_labels(problem, motion):
    titles = [axes.get_title(loc="left") for axes in mbd.viz.failure_map(motion, "arm").axes[:2]]
    assert [title.partition(":")[0] for title in titles] == ["design 1", "design 2"]
    legend = mbd.viz.criteria_over_time(problem, motion).legends[0]
    assert [text.get_text() for text in legend.get_texts()][:2] == ["design 1", "design 2"]


def test_bodies_without_plies_have_no_failure_map(motion):
    with refused("tool"):
        mbd.viz.failure_map(motion, "tool", LABELS)


def test_parallel_coordinates():
    X, y = np.array([[45.0, 0.0], [30.0, 60.0], [0.0, 0.0]]), [2.0, 1.0, 0.5]
    figure = mbd.viz.parallel_coordinates(X, y, ["a [deg]", "b"], [True, True, False], (-90.0, [np.inf, -np.inf][0]))
    best = next(line for line in figure.axes[0].lines if line.get_label() == "best")
    assert_allclose(best.get_ydata(), [(30 + 90) / 135, 1.0, (1.0 - 0.5) / 1.5])
    for axis in figure.axes[0].collections:  # an axis does not cross its numbers
        assert_allclose(axis.get_paths()[0].vertices[:, 1], [0.0, 1.0])
    low, high = mbd.viz.parallel_coordinates([[1.0, 2.0]], [3.0], ["a", "b"], bounds=(-9.0, 9.0)).axes[0].get_ylim()
    assert low < -0.03  # the numbers of the axes lie inside with one design, too
    assert high > 1.03
    long = "integral of squared x velocity of tool, plus squared y velocity of tool [m2/s]"
    axes = mbd.viz.parallel_coordinates(X, y, ["a [deg]", "b"], objective=long).axes[0]
    assert axes.get_xticklabels()[-1].get_text() == "objective\n[m2/s]"
    assert axes.get_xlabel().replace("\n", " ") == f"objective: {long}"
    with refused("designs"):
        mbd.viz.parallel_coordinates(X, y[:2], ["a", "b"])


def test_histories_inside_of_sums_and_products_are_found():
    both = 2.0 * mbd.Max(ENERGY) + mbd.RMS(ANGLE)
    assert [history for history, _ in histories_of(both)] == [ENERGY, ANGLE]
