"""Maps of design spaces: what is drawn is what was visited."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.refused import refused
from torchmbd.viz import design_map, save

RNG = np.random.default_rng(2)
PATHS = {name: RNG.normal(size=(k, 2)) for name, k in (("a", 4), ("b", 3), ("c", 2))}
OBJECTIVES = {name: RNG.random(len(path)) for name, path in PATHS.items()}


def lines(axes) -> list[np.ndarray]:
    return [line.get_xydata() for line in axes.lines]


@pytest.mark.thorough
def test_two_variables(tmp_path):
    X, y = RNG.normal(size=(30, 2)), RNG.random(30)
    y[3] = np.nan
    figure = design_map(PATHS, OBJECTIVES, ["one [deg]", "two"], {"a": 0, "b": 0}, (X, y))
    axes, bar = figure.axes
    drawn = lines(axes)
    for k, path in enumerate(PATHS.values()):
        assert_array_equal(drawn[3 * k], path)
        assert_array_equal(drawn[3 * k + 2][0], path[-1])  # where it ended
    colors = [line.get_color() for line in axes.lines[::3]]
    assert colors[0] == colors[1] != colors[2]  # one basin, and a search that ended nowhere
    (dots,) = [c for c in axes.collections if len(c.get_offsets()) == 29]  # the failed one is left out
    assert_array_equal(dots.get_array(), y[np.isfinite(y)])
    assert (axes.get_xlabel(), axes.get_ylabel(), bar.get_ylabel()) == ("one [deg]", "two", "objective")
    assert save(figure, tmp_path / "map.png").stat().st_size > 5000


def test_one_variable():
    paths = {name: path[:, :1] for name, path in PATHS.items()}
    X = np.array([[3.0], [1.0], [2.0]])
    figure = design_map(paths, OBJECTIVES, ["angle [deg]"], {"c": 1}, (X, np.array([9.0, 7.0, 8.0])), "energy")
    drawn = lines(figure.axes[0])
    assert_array_equal(drawn[0], [[3, 9], [1, 7], [2, 8]])
    assert_array_equal(drawn[1], np.c_[paths["a"], OBJECTIVES["a"]])
    assert figure.axes[0].get_ylabel() == "energy"


@pytest.mark.thorough
def test_more_variables_are_seen_in_the_plane_in_which_they_spread_most(tmp_path):
    turn = np.linalg.qr(RNG.normal(size=(4, 4)))[0]
    flat = {name: np.c_[path, np.zeros((len(path), 2))] for name, path in PATHS.items()}
    X = np.concatenate(list(flat.values()))
    figure = design_map(flat, OBJECTIVES, list("abcd"), {"a": 0}, (X @ turn, np.arange(len(X)) + 1.0))
    axes = figure.axes[0]
    drawn = np.concatenate([lines(axes)[3 * k] for k in range(3)])
    span = np.ptp(X, axis=0)
    scaled = X[:, :2] / span[:2]
    apart = np.linalg.norm(scaled[:, None] - scaled[None], axis=-1)
    assert_allclose(np.linalg.norm(drawn[:, None] - drawn[None], axis=-1), apart, atol=1e-12)  # nothing is lost
    shares = [float(text.partition("(")[2].partition("%")[0]) for text in (axes.get_xlabel(), axes.get_ylabel())]
    assert sum(shares) == pytest.approx(100.0, abs=1.0)
    assert "mostly" in axes.get_xlabel()
    save(figure, tmp_path / "map.png")


def test_a_single_design_of_many_variables():
    design_map({"a": np.zeros((1, 3))}, {"a": np.zeros(1)}, list("xyz"))


@pytest.mark.parametrize("count", [3, 0])
def test_headings_must_fit(count):
    with refused("paths"):
        design_map(PATHS, OBJECTIVES, ["x"] * count)


@pytest.mark.thorough
def test_five_hundred_minima_leave_the_axes_their_room():
    """The legend names the best minima only."""
    paths = {f"start {k}": np.array([[float(k), 0.0], [float(k), 1.0]]) for k in range(500)}
    figure = design_map(
        paths, {name: np.array([2.0, 1.0]) for name in paths}, ["a", "b"], {n: k for k, n in enumerate(paths)}
    )
    figure.canvas.draw()
    assert len(figure.legends[0].get_texts()) == 11
    assert figure.axes[0].get_position().height > 0.5
