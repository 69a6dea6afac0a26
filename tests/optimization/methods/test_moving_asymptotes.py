"""NLopt's methods: its errors end a start with a status."""

from __future__ import annotations

import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize

nlopt = pytest.importorskip("nlopt")
NAMES = ("RoundoffLimited", "invalid_argument", "runtime_error")  # each in some versions
ERRORS = [getattr(nlopt, name) for name in NAMES if hasattr(nlopt, name)]


@pytest.mark.parametrize("error", [*ERRORS, RuntimeError, ValueError])
@pytest.mark.parametrize("method", ["mma", "ccsaq"])
def test_an_error_of_nlopt_is_a_status(monkeypatch, error, method):
    """Its classes are below Exception alone in some versions, and say nothing."""

    class Refusing(nlopt.opt):
        def optimize(self, y):
            super().optimize(y)
            raise error("")

    monkeypatch.setattr(nlopt, "opt", Refusing)
    bowl = Analytic("bowl", [2.0, 1.0], lambda x: (x[0] - 1.0) ** 2 + x[1] ** 2 + 1.0, lower=-3.0, upper=3.0)
    result = optimize(bowl, method, max_iterations=20)
    assert "NLopt gave up" in result.message
    assert error.__name__ in result.message
    assert result.value == pytest.approx(1.0, abs=1e-3)  # of the best design before
