"""Workers: the same numbers as here, whoever dies."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest

from torchmbd.errors import InputError, MbdError
from torchmbd.experiment.assemble import problem_of
from torchmbd.experiment.farm import Farm, evaluate_piece
from torchmbd.experiment.load import load_study
from torchmbd.experiment.place import problem_key

SHORT = {"duration": 0.002, "steps": 8}
X = np.radians([[45.0, -45.0], [10.0, 20.0], [0.0, 5.0], [30.0, 60.0], [-80.0, 7.0]])


def same(found, expected):
    assert [e.status for e in found] == [e.status for e in expected]
    for one, other in zip(found, expected, strict=True):
        assert one.objective == pytest.approx(other.objective, rel=1e-9)
        np.testing.assert_allclose(one.constraints, other.constraints, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one.objective_gradient, other.objective_gradient, rtol=1e-7, atol=1e-9)


def test_a_piece_is_what_the_problem_itself_gives(write):
    plan = load_study(write(simulate=SHORT))
    farm = Farm(plan, problem_key(plan), 1, 2)
    same(evaluate_piece(*farm._order, X[:2], True), problem_of(plan).evaluate(X[:2], True))


def test_another_model_file_on_a_worker_is_refused(write, folder):
    plan = load_study(write(simulate=SHORT))
    farm = Farm(plan, problem_key(plan), 1, 2)
    model = folder / "rod_model.py"
    model.write_text(model.read_text() + "\n# changed\n")
    with pytest.raises(MbdError, match="another model file"):
        evaluate_piece(*farm._order, X[:2], True)


def test_bad_numbers_of_workers_are_named(write):
    with pytest.raises(InputError, match="workers = -1"):
        Farm(load_study(write(simulate=SHORT)), "", 1, -1)


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_nothing(write):
    plan = load_study(write(simulate={"duration": 0.01, "steps": 100}))
    with Farm(plan, problem_key(plan), 1, 2) as farm:
        expected = problem_of(plan).evaluate(X, True)
        same(farm.evaluate(X, True), expected)
        victim = next(iter(farm._client.run(os.getpid).values()))
        os.kill(victim, signal.SIGKILL)
        same(farm.evaluate(X, True), expected)


@pytest.mark.slow
def test_a_scheduler_of_the_users(write):
    from distributed import LocalCluster

    plan = load_study(write(simulate=SHORT))
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster,
        Farm(plan, problem_key(plan), 1, 0, cluster.scheduler_address) as farm,
    ):
        same(farm.evaluate(X, True), problem_of(plan).evaluate(X, True))
