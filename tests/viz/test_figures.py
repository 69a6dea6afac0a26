"""Figures: what is drawn is what was given."""

from __future__ import annotations

import numpy as np
import pytest

from tests.refused import refused
from torchmbd.viz import convergence, criterion, energy_over_time, save


@pytest.mark.thorough
def test_every_start_is_drawn_and_the_best_on_top():
    objectives = {"start 0": [1.0, 0.5, 0.2], "start 1": [2.0, 0.1], "start 2": [3.0]}
    figure = convergence(objectives, {name: [0.0] * len(v) for name, v in objectives.items()}, best="start 1")
    top, bottom = figure.axes
    assert [list(line.get_ydata()) for line in top.lines] == [[1.0, 0.5, 0.2], [3.0], [2.0, 0.1]]
    assert len(bottom.lines) == 3
    assert top.get_legend().get_texts()[0].get_text() == "best: start 1"
    assert top.get_yscale() == "log"
    assert list(bottom.get_yticks()) == [0.0]
    assert len(convergence(objectives, {"start 0": [0.3, 0.0, 0.0]}).axes[1].get_yticks()) > 1
    assert convergence({"a": [1.0, -1.0]}, {}).axes[0].get_yscale() == "linear"


def test_energies_are_labelled():
    t = np.linspace(0, 0.06, 5)
    (axes,) = energy_over_time(t, {"start design": t**2, "optimum": t**3}, body="rod").axes
    assert axes.get_ylabel() == "strain energy of rod [J]"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["start design", "optimum"]
    np.testing.assert_array_equal(axes.lines[1].get_ydata(), t**3)


def test_a_failed_evaluation_is_a_marked_gap():
    values, ratio = [-90, 0, 90], [1.1, np.nan, 1.2]
    (axes,) = criterion(values, {"integral": ratio}, "angle 1 [deg]", mark=45.0).axes
    assert np.isnan(axes.lines[0].get_ydata()[1])
    assert list(axes.lines[1].get_xdata()) == [0]
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["integral", "failed evaluation", "start design"]


@pytest.mark.thorough
@pytest.mark.parametrize(("ending", "magic"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_figures_are_written_by_their_ending(tmp_path, ending, magic):
    path = save(energy_over_time([0, 1], {"a": [0, 1]}), tmp_path / f"f.{ending}")
    assert path.read_bytes().startswith(magic)


def test_bad_arguments_are_named(tmp_path):
    with refused("objectives", {}):
        convergence({}, {})
    with refused("path"):
        save(energy_over_time([0, 1], {"a": [0, 1]}), tmp_path / "f.gif")


def test_a_history_that_ends_in_a_failure_stops_there_and_says_so():
    t, nan = [0.0, 0.1, 0.2, 0.3], float("nan")
    (axes,) = energy_over_time(t, {"whole": [0.0, 1.0, 2.0, 1.0], "initial": [0.0, 3.0, nan, nan]}).axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["whole", "initial (fails at t = 0.1 s)"]
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in crosses] == [(0.1, 3.0)]
