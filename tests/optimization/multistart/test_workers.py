"""Batches shared out among processes: the same answers, whatever becomes of the processes."""

from __future__ import annotations

import copy
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import dask
import numpy as np
import psutil
import pytest

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.optimization import Evaluation
from torchmbd.process import thread_count

pytestmark = pytest.mark.thorough


class Overflow(Exception):
    """As a user may have it."""


class Bowl:
    """A sum of squares about a center that a closure holds, and who evaluated it."""

    def __init__(self, center: float):
        self.start, self.lower, self.upper = np.array([0.5, 0.5]), -np.ones(2), np.ones(2)
        self.names = ["x", "y"]
        self.center = lambda: center  # not to be had by pickle
        self.seen: list[int] = []

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        self.seen.append(len(X))
        if X.max() >= 4.0:
            os.kill(os.getpid(), signal.SIGKILL)
        if X.max() >= 3.0:
            raise Overflow(f"a bowl is full at {X.max():g}")
        pid = np.array([-float(os.getpid())])  # a constraint that always holds
        return [
            Evaluation(float(((x - self.center()) ** 2).sum()), pid, 2 * (x - self.center()), 0 * x[None]) for x in X
        ]


@pytest.fixture(scope="module")
def shared():
    with mbd.optimization.Processes(Bowl(0.25), 2) as problem:
        problem.wait()
        yield problem


def test_the_process_is_left_as_it_was(monkeypatch):
    """Environment, threads, Dask's settings and loggers, after a block; inside of it the first two."""
    monkeypatch.delenv("TORCHMBD_THREADS", raising=False)

    def here():
        loggers = [
            logging.getLogger(name).level for name in ("distributed", "distributed.client", "tornado.application")
        ]
        return dict(os.environ), thread_count(), copy.deepcopy(dask.config.config), loggers

    import distributed  # noqa: F401  which sets its own defaults

    before = here()
    with mbd.optimization.Processes(Bowl(0.25), 2) as problem:
        problem.wait()
        assert here()[:2] == before[:2]
        with pytest.raises(Overflow):
            problem.evaluate(np.full((2, 2), 3.5), True)
        monkeypatch.setenv("TORCHMBD_TEST", "of the caller")  # inside of the block, and his own
    environment, *others = here()
    assert environment.pop("TORCHMBD_TEST") == "of the caller"
    assert (environment, *others) == before


def test_a_batch_is_shared_out_in_order(shared):
    X = np.linspace(-1, 1, 14).reshape(7, 2)
    result = shared.evaluate(X, True)
    assert [e.objective for e in result] == [e.objective for e in Bowl(0.25).evaluate(X, True)]
    assert len({float(e.constraints[0]) for e in result} - {-float(os.getpid())}) == 2
    assert shared.problem.seen == []  # nothing was evaluated here


def test_all_else_is_the_problem_s_own(shared):
    assert shared.start is shared.problem.start
    with pytest.raises(AttributeError, match="period"):
        _ = shared.period


def test_an_optimizer_does_not_notice(shared):
    starts = mbd.optimization.sobol(6, seed=3)
    together, alone = (mbd.optimization.multistart(problem, "slsqp", starts) for problem in (shared, Bowl(0.25)))
    assert [r.value for r in together.results] == [r.value for r in alone.results]
    assert together.converged == 6


def test_an_error_of_the_problem_is_the_caller_s(shared):
    with pytest.raises(Overflow, match="a bowl is full at 3"):
        shared.evaluate(np.full((2, 2), 3.0), False)
    assert len(shared.evaluate(np.zeros((2, 2)), False)) == 2


@pytest.mark.slow
def test_a_design_that_kills_its_processes_has_failed(shared):
    (result,) = shared.evaluate(np.full((1, 2), 4.0), False)
    assert result.status == "failed: 3 workers died of it"
    assert [e.ok for e in shared.evaluate(np.zeros((2, 2)), False)] == [True, True]


def test_a_problem_that_cannot_travel_is_refused():
    bowl = Bowl(0.0)
    bowl.center = threading.Lock()  # pyright: ignore[reportAttributeAccessIssue]
    with refused("problem", ANY, "cannot pickle"):
        mbd.optimization.Processes(bowl, 2)


@pytest.mark.parametrize("count", [0, -1, True, 1.5, "two"])
def test_a_count_that_is_none(count):
    with refused("count"):
        mbd.optimization.Processes(Bowl(0.0), count)


SCRIPT = """
import os, time
import torchmbd as mbd
from tests.optimization.multistart.test_workers import Bowl

if __name__ == "__main__":
    with mbd.optimization.Processes(Bowl(0.0), 2) as shared:
        shared.wait()
        print("ready", flush=True)
        time.sleep(60)
"""


@pytest.mark.slow
def test_a_caller_that_is_killed_leaves_nobody_behind(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    with subprocess.Popen([sys.executable, tmp_path / "script.py"], env=environment, stdout=subprocess.PIPE) as caller:
        assert caller.stdout is not None
        assert caller.stdout.readline() == b"ready\n"
        workers = psutil.Process(caller.pid).children(recursive=True)
        assert len(workers) >= 2
        caller.kill()
    for _ in range(300):
        if not any(worker.is_running() and worker.status() != psutil.STATUS_ZOMBIE for worker in workers):
            return
        time.sleep(0.1)
    pytest.fail(f"still there: {workers}")
