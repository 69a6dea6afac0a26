"""What is known is not evaluated again, wherever it is evaluated."""

from __future__ import annotations

import numpy as np

from tests.optimization.analytic import Analytic
from tests.optimization.multistart.test_batched import Elsewhere, valley
from tests.refused import ANY, refused
from torchmbd.optimization import optimize_discrete, sobol
from torchmbd.optimization.cache import CachedProblem, MemoryCachedProblem, MemoryStore

X = np.array([[0.5, 0.5], [1.0, -1.0], [2.0, 0.0]])


def bowl() -> Analytic:
    return Analytic("bowl", [1.0, 1.0], lambda x: x[0] ** 2 + x[1] ** 2 + 1, lower=-3, upper=3)


def test_each_design_is_evaluated_once():
    problem = bowl()
    cache = MemoryCachedProblem(problem)
    values = [e.objective for e in cache.evaluate(X[[0, 1, 0]], True)]
    assert values == [1.5, 3.0, 1.5]
    assert problem.batches == [(2, True)]
    assert [e.objective for e in cache.evaluate(X, False)] == [1.5, 3.0, 5.0]
    assert problem.batches == [(2, True), (1, False)]
    cache.evaluate(X[2:], True)  # its values are known, its gradients are not
    assert problem.batches[2:] == [(1, True)]
    assert (cache.hits, cache.computed, cache.batches) == (3, 4, 3)
    assert len(cache.memory.entries) == 3


def test_a_batch_is_told_before_it_is_evaluated():
    told, problem = [], bowl()
    cache = CachedProblem(problem, MemoryStore(), begun=lambda *batch: told.append((*batch, len(problem.batches))))
    cache.evaluate(X[:2], True)
    cache.evaluate(X[:2], True)  # nothing to evaluate
    cache.evaluate(X, True)
    assert told == [(1, 2, 0), (2, 1, 1)]


def test_a_failure_is_remembered():
    cache = MemoryCachedProblem(Analytic("wall", [1.0], lambda x: x[0], lower=-3, upper=3, fails=lambda x: True))
    for gradients in (False, True):
        (result,) = cache.evaluate(X[:1, :1], gradients)
        assert not result.ok
    assert cache.computed == 1


def test_too_few_answers_are_refused():
    problem = bowl()
    problem.evaluate = lambda X, gradients: []
    with refused("problem.evaluate", ANY, "0 evaluations for 3 designs"):
        MemoryCachedProblem(problem).evaluate(X, False)


def test_what_is_evaluated_elsewhere_is_remembered_as_well():
    here, elsewhere = (
        optimize_discrete(problem, 0.25, "slsqp", sobol(4, seed=3), max_neighbors=30)
        for problem in (valley(), Elsewhere(valley(), 3))
    )
    assert elsewhere.best is not None
    assert here.best is not None
    assert elsewhere.best.value == here.best.value
    assert elsewhere.analyses > 20
    assert len(elsewhere.candidates) > 4
