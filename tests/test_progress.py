"""Progress bars: shown on request, silent otherwise; results as tables and figures."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.optimization.analytic import Analytic
from torchmbd import cli
from torchmbd import progress as bars


def bowl() -> Analytic:
    return Analytic("bowl", [3.0, 2.0], lambda x: (x[0] - 1.0) ** 2 + x[1] ** 2, lower=-5.0, upper=5.0)


@pytest.mark.parametrize("progress", [True, False, None])
def test_it_is_shown_on_request(progress, capsys):
    heard = []
    result = mbd.optimize(bowl(), "slsqp", progress=progress, callback=heard.append)
    assert result.converged
    assert len(heard) == len(result.history)
    shown = capsys.readouterr()
    assert ("objective" in shown.err) is (progress is True)
    assert shown.out == ""


def test_starts_are_counted(capsys):
    study = mbd.optimization.multistart(bowl(), "slsqp", mbd.optimization.sobol(3, seed=1), progress=True)
    assert "3/3" in capsys.readouterr().err
    frame = study.to_dataframe()
    assert list(frame.index) == [0, 1, 2]
    np.testing.assert_array_equal(frame["value"], [one.value for one in study.results])
    assert study.best is not None
    assert len(study.plot().axes[0].lines) == 3
    assert len(study.best.plot("bowl").axes[0].lines) == 1
    for result in (study, study.best):
        assert len(repr(result).splitlines()) < 10
        assert "converged" in result._repr_html_()


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "dopri5"])
def test_a_motion_has_a_bar_on_request(method, capsys):
    mbd.simulate(mbd.examples.pendulum(), 0.05, method, steps=5, progress=True)
    assert "simulate" in (text := capsys.readouterr().err)
    assert "/0.05 s" in text
    mbd.simulate(mbd.examples.pendulum(), 0.05, method, steps=5)
    assert capsys.readouterr().err == ""


@pytest.mark.thorough
def test_a_short_motion_has_none_in_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(bars.sys.stderr, "isatty", lambda: True, raising=False)
    mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    assert "simulate" not in capsys.readouterr().err
    monkeypatch.setattr(bars, "DELAY", 0.0)
    mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    assert "simulate" in capsys.readouterr().err


@pytest.mark.thorough
def test_the_command_line_leaves_bars_as_they_were(capsys):
    assert cli.main(["list", "no.such.folder"]) == 2
    capsys.readouterr()
    mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50, progress=True)
    assert "simulate" in capsys.readouterr().err


@pytest.mark.thorough
def test_motions_of_an_optimization_have_none(monkeypatch, capsys):
    monkeypatch.setattr(bars, "DELAY", 0.0)
    monkeypatch.setattr(bars.sys.stderr, "isatty", lambda: True, raising=False)
    energy = mbd.Integral(mbd.StrainEnergy("arm"))
    problem = mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-90, 90]))
    mbd.optimize(problem, max_iterations=1, progress=False)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("progress", "line"), [(None, True), (False, False)])
def test_a_long_stage_has_one_line_in_a_script(progress, line, monkeypatch, capsys):
    """A stage within it has none; the thread that writes begins at once and is waited for by the stage within."""
    monkeypatch.setattr(bars, "PATIENCE", 0.0)
    written = bars.threading.Event()
    monkeypatch.setattr(bars.sys.stderr, "flush", written.set, raising=False)
    with bars.quietly(progress is False), bars.stage("choosing the steps"), bars.stage("compiling"):
        assert written.wait(10.0 if line else 0.01) is line
    assert capsys.readouterr().err == "torchmbd: choosing the steps ...\n" * line


def test_a_short_stage_has_no_line(capsys):
    with bars.stage("choosing the steps"):
        pass
    assert capsys.readouterr().err == ""


def test_a_stage_is_told_to_who_listens(monkeypatch, capsys):
    monkeypatch.setattr(bars, "PATIENCE", 0.0)
    heard = []
    with bars.stages_told(heard.append), bars.stage("choosing the steps"):
        bars.begin_stage("compiling")
    assert heard == ["choosing the steps", "compiling"]
    assert capsys.readouterr().err == ""


def test_a_long_motion_says_so_before_it_starts(capsys):
    with bars.motion_shown(True, 1.0):
        bars.announce(54_348, 3)
        bars.announce(400, 3)
    with bars.without_bars():
        bars.announce(54_348, 3)
    assert capsys.readouterr().err.count("a motion of 54348 steps begins, of 3 designs") == 1
