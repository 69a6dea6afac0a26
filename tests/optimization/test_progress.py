"""Progress bars: shown on request, silent otherwise; results as tables and figures."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.optimization.analytic import Analytic


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
    study = mbd.multistart(bowl(), "slsqp", mbd.sobol(3, seed=1), progress=True)
    assert "3/3" in capsys.readouterr().err
    frame = study.to_dataframe()
    assert list(frame.index) == [0, 1, 2]
    np.testing.assert_array_equal(frame["value"], [one.value for one in study.results])
    assert study.best is not None
    assert len(study.plot().axes[0].lines) == 3
    assert len(study.best.plot("bowl").axes[0].lines) == 1
    for found in (study, study.best):
        assert len(repr(found).splitlines()) < 10
        assert "converged" in found._repr_html_()
