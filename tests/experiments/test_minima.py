"""How many simulations a search needs to come near the best, with gradients in common batches and without."""

from __future__ import annotations

import re

import numpy as np

from experiments.paper.minima import beside_evolution, simulations_to
from tests.optimization.analytic import Analytic
from tests.optimization.methods.test_evolution import rastrigin
from torchmbd.optimization.multistart import multistart


def test_searches_in_batches_are_counted_until_the_first_is_there():
    study = multistart(rastrigin(), "slsqp", [[3.1, -4.2], [0.1, 0.2], [1.2, 0.1]])
    ends = {r.start: r for r in study.results}
    best = min(r.value for r in study.results)
    assert ends[1].value == best
    first = next(i.analyses for i in ends[1].history if i.objective <= 1.001 * best)
    assert simulations_to(1.001 * best, [ends[1]]) == first
    assert simulations_to(1.001 * best, study.results) == sum(min(r.analyses, first) for r in study.results)
    assert simulations_to(0.5 * best, study.results) is None


def test_both_ways_are_shown_together():
    waves = Analytic(
        "waves", [3.1, -4.2], lambda x: 21 + sum(t**2 - 4 * np.cos(2 * t + 0.3) for t in x), lower=-5.0, upper=5.0
    )
    with_gradients, without = beside_evolution(waves, starts=16, generations=60, population=8)
    counts = [int(n) for n in re.findall(r"after (\d+)", with_gradients + without)]
    assert re.search(r"within 0.1 % of the best after \d+ of all: \d+ of 16 starts, each after", with_gradients)
    assert counts[0] < counts[-1]
