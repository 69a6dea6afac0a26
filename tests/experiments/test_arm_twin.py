"""The arm that measures itself: its fits from 30 % off end at the truth; all draws are made by hand (see the module)."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.models import arm_twin


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_two_draws(compiled):
    results = arm_twin.draws(2)
    truth = np.array([*arm_twin.TRUTH.values(), arm_twin.DELAY])
    for fit in results:
        assert fit.status == "converged"
        assert fit.evaluations <= 15
        assert (np.abs(fit.x - truth) < 4.0 * fit.deviation).all()
        assert fit.unseen == []
